"""Settings of every algorithm: frozen dataclasses, one string under each field.

The command line, the run's JSON and the documentation are generated from these. This module
does not import torch, so that ``--help`` and argument errors are instant.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from skillweave.networks.config import MLP
from skillweave.types import SkillweaveError


def _check(config: object, field_name: str, ok: bool, asked: str) -> None:
    if not ok:
        value = getattr(config, field_name)
        raise SkillweaveError(
            f"{type(config).__name__}.{field_name} is {value!r}; it must be {asked}"
        )


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation (Schulman et al. 2017)."""

    num_envs: int = 64
    """Environments stepped side by side."""
    n_steps: int = 64
    """Steps of each environment between updates."""
    batch_size: int = 1024
    """Samples of one gradient step (a minibatch)."""
    update_epochs: int = 4
    """Passes over each rollout."""
    learning_rate: float = 1e-3
    """Adam's step size, at the start."""
    learning_rate_schedule: Literal["constant", "linear", "kl"] = "linear"
    """constant; linear: falls to 0 over the budget; kl: follows target_kl."""
    adam_eps: float = 1e-5
    """Adam's ε."""
    gamma: float = 0.99
    """Discount γ of one step."""
    gae_lambda: float = 0.95
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
    normalize_obs: bool = False
    """Running zero mean, unit deviation of observations; saved with the policy."""
    normalize_returns: bool = True
    """The critic learns returns in units of their running deviation: no reward is too large."""
    action_std_init: float = 0.6
    """Initial standard deviation of continuous actions, where a bounded range spans [−1, 1]."""
    network: MLP = field(default_factory=MLP)
    """The actor's network."""
    critic: MLP | None = None
    """The critic's network; None: as the actor's."""
    overlap: bool = True
    """Collect the next rollout while learning from the last: the data is one update old."""
    threads: int = 1
    """Torch threads while learning."""

    def __post_init__(self) -> None:
        for name in ("num_envs", "n_steps", "batch_size", "update_epochs", "threads"):
            _check(self, name, getattr(self, name) >= 1, "at least 1")
        for name in ("gamma", "gae_lambda"):
            _check(self, name, 0.0 <= getattr(self, name) <= 1.0, "between 0 and 1")
        for name in ("learning_rate", "clip_coef", "max_grad_norm", "action_std_init", "adam_eps"):
            _check(self, name, 0.0 < getattr(self, name) < float("inf"), "positive and finite")
        for name in ("ent_coef", "vf_coef"):
            _check(self, name, 0.0 <= getattr(self, name) < float("inf"), "at least 0 and finite")
        final = self.ent_coef_final
        _check(self, "ent_coef_final", final is None or 0.0 <= final < float("inf"), "at least 0")
        for name in ("target_kl", "clip_value"):
            _check(self, name, getattr(self, name) is None or getattr(self, name) > 0, "positive")
        if self.learning_rate_schedule == "kl":
            _check(self, "target_kl", self.target_kl is not None, "set for the schedule 'kl'")
        schedules = ("constant", "linear", "kl")
        ok = self.learning_rate_schedule in schedules
        _check(self, "learning_rate_schedule", ok, f"one of {', '.join(schedules)}")
        rollout = self.num_envs * self.n_steps
        _check(
            self, "batch_size", self.batch_size <= rollout, f"at most num_envs·n_steps ({rollout})"
        )


AlgorithmConfig = PPO
"""Any algorithm's settings."""

_KINDS = {"PPO": PPO}


def config_to_json(config: AlgorithmConfig) -> dict[str, Any]:
    """Settings as plain JSON, with the algorithm's name under ``algorithm``."""
    return {"algorithm": type(config).__name__, **asdict(config)}


def config_from_json(data: dict[str, Any]) -> AlgorithmConfig:
    """The inverse of ``config_to_json``.

    Raises:
        SkillweaveError: an unknown algorithm or field, named, or a value out of range.
    """
    values = dict(data)
    kind = values.pop("algorithm", None)
    if kind not in _KINDS:
        raise SkillweaveError(f"unknown algorithm {kind!r}; known are: {', '.join(_KINDS)}")
    _check_fields(values, _KINDS[kind], kind)
    for name in ("network", "critic"):
        if values.get(name) is not None:
            values[name] = _mlp_from_json(values[name], f"{kind}.{name}")
    return _KINDS[kind](**values)


def _mlp_from_json(data: dict[str, Any], where: str) -> MLP:
    _check_fields(data, MLP, where)
    return MLP(**{**data, "hidden": tuple(data["hidden"])})


def _check_fields(values: dict[str, Any], kind: type, where: str) -> None:
    unknown = sorted(set(values) - {f.name for f in fields(kind)})
    if unknown:
        raise SkillweaveError(
            f"{where} has no field {', '.join(unknown)}: made by a newer version?"
        )
