"""Settings of every algorithm: frozen dataclasses, one string under each field.

The command line, the run's JSON and the documentation are generated from these. This module
does not import torch, so that ``--help`` and argument errors are instant.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal, TypeAlias

import gymnasium as gym

from skillweave.algorithms.config_off_policy import (
    DQN,
    SAC,
    TD3,
    OffPolicy,
    check,
    check_networks,
    flags,
    number,
    one_of,
    positive,
    whole,
)
from skillweave.networks.config import Network
from skillweave.reading import fit, shown
from skillweave.types import SkillweaveError


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation (Schulman et al. 2017)."""

    num_envs: int = 64
    """Environments stepped side by side."""
    n_steps: int = 64
    """Environment steps of each environment between updates, for selectors too."""
    batch_size: int = 256
    """Samples of one gradient step (a minibatch), about; a smaller rollout is one minibatch."""
    update_epochs: int = 4
    """Passes over each rollout."""
    learning_rate: float = 1e-3
    """Adam's step size, at the start."""
    learning_rate_schedule: Literal["constant", "linear", "kl"] = "linear"
    """constant; linear: falls to 0 over the budget; kl: follows target_kl."""
    adam_eps: float = 1e-5
    """Adam's ε."""
    gamma: float = 0.995
    """Discount γ of one step."""
    gae_lambda: float = 0.98
    """λ of generalised advantage estimation."""
    clip_coef: float = 0.2
    """ε of the clipped surrogate."""
    clip_value: float | None = None
    """How far a value may move per update, in units of normalised returns; None: freely."""
    ent_coef: float = 0.01
    """Weight of the entropy bonus."""
    ent_coef_final: float | None = None
    """Weight of the entropy bonus at the end of the budget, reached linearly; None: constant."""
    vf_coef: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 0.5
    """Gradients are scaled down to this norm."""
    target_kl: float | None = None
    """KL at which an update stops early, or that the 'kl' schedule aims at."""
    normalize_advantage: bool = True
    """Zero mean, unit deviation of the advantages of each update."""
    normalize_obs: bool = True
    """Running zero mean, unit deviation of observations; saved with the policy."""
    normalize_returns: bool = True
    """The critic learns returns in units of their running deviation: no reward is too large."""
    action_std_init: float = 0.6
    """Initial standard deviation of continuous actions, where a bounded range spans [−1, 1]."""
    action_std: Literal["parameter", "state"] = "parameter"
    """The deviation is a parameter of its own, or depends on the state."""
    squash_actions: bool = False
    """Continuous actions go through tanh, else they are clipped to the bounds."""
    network: Network = field(default_factory=Network)
    """The actor's network."""
    critic: Network | None = None
    """The critic's network; None: as the actor's."""
    overlap: bool = True
    """Collect the next rollout while learning from the last: the data is one update old."""
    threads: int = 1
    """Torch threads while learning."""

    def __post_init__(self) -> None:
        check_networks(self)
        flags(self)
        whole(self, "num_envs", "n_steps", "batch_size", "update_epochs", "threads")
        number(self, "gamma", "gae_lambda", high=1.0)
        positive(self, "learning_rate", "clip_coef", "max_grad_norm", "action_std_init", "adam_eps")
        number(self, "ent_coef", "vf_coef")
        if self.ent_coef_final is not None:
            number(self, "ent_coef_final")
        positive(self, *(k for k in ("target_kl", "clip_value") if getattr(self, k) is not None))
        one_of(self, "action_std", ("parameter", "state"))
        if self.learning_rate_schedule == "kl":
            check(self, "target_kl", self.target_kl is not None, "set for the schedule 'kl'")
        one_of(self, "learning_rate_schedule", ("constant", "linear", "kl"))
        if self.network.rnn is not None:
            check(self, "critic", self.critic is None, "None where network.rnn is set")
        rollout = self.num_envs * self.n_steps
        most = max(rollout, PPO.batch_size)  # a small rollout alone is no mistake
        says = f"at most {most}; a rollout has num_envs·n_steps ({rollout}) samples"
        check(self, "batch_size", self.batch_size <= most, says)


AlgorithmConfig: TypeAlias = PPO | DQN | TD3 | SAC
"""Any algorithm's settings."""

_KINDS: dict[str, Any] = {"PPO": PPO, "DQN": DQN, "TD3": TD3, "SAC": SAC}
_SPACES = gym.spaces
_ACTS: dict[str, tuple[type, ...]] = {
    "PPO": (_SPACES.Discrete, _SPACES.MultiDiscrete, _SPACES.MultiBinary, _SPACES.Box),
    "DQN": (_SPACES.Discrete,),
    "TD3": (_SPACES.Box,),
    "SAC": (_SPACES.Box, _SPACES.Discrete),
}
"""The action spaces that each algorithm can act in."""


def check_spaces(config: AlgorithmConfig, action_space: gym.Space[Any], where: str = "") -> None:
    """Raise a SkillweaveError where an algorithm cannot act in a space; it names those that can."""
    kind = type(config).__name__
    if not isinstance(action_space, _ACTS[kind]):
        able = [name for name, spaces in _ACTS.items() if isinstance(action_space, spaces)]
        raise SkillweaveError(
            f"{where}{kind} cannot act in {action_space}; "
            + (f"{', '.join(able)} can" if able else "no algorithm here can")
        )


def named_config(name: str, where: str) -> AlgorithmConfig:
    """An algorithm's or a preset's default settings by name, in any case.

    Raises:
        SkillweaveError: there is none of this name; the message, which begins with ``where``,
            lists them.
    """
    presets: dict[str, Any] = {**_KINDS, "Rainbow": DQN.rainbow, "DDPG": TD3.ddpg}
    for known, make in presets.items():
        if known.lower() == name.lower():
            config: AlgorithmConfig = make()
            return config
    raise SkillweaveError(f"{where}: no algorithm {name!r}; there are: {', '.join(presets)}")


def config_to_json(config: AlgorithmConfig) -> dict[str, Any]:
    """Settings as plain JSON, with the algorithm's name under ``algorithm``."""
    return {"algorithm": type(config).__name__, **asdict(config)}


def config_from_json(data: Any, file: str = "", path: str = "") -> AlgorithmConfig:
    """The inverse of ``config_to_json``.

    Args:
        file: where it was read, for messages.
        path: the field in it: ``stages[0].algorithm``.

    Raises:
        SkillweaveError: an unknown algorithm or field, named, or a value of another type or out
            of range.
    """
    values: dict[str, Any] = fit(dict[str, Any], data, file, path)
    kind = values.pop("algorithm", None)
    if not isinstance(kind, str) or kind not in _KINDS:
        where = f"{file}: {path}: " if file else ""
        known = ", ".join(_KINDS)
        raise SkillweaveError(f"{where}unknown algorithm {shown(kind)}; known are: {known}")
    config: AlgorithmConfig = fit(_KINDS[kind], values, file, path or kind)
    return config


__all__ = ["DQN", "PPO", "SAC", "TD3", "AlgorithmConfig", "OffPolicy"]
