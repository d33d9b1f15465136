"""Settings of the algorithms that learn from their own latest rollout; see ``config``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from skillweave.algorithms.config_checks import (
    check,
    check_networks,
    compiles,
    flags,
    number,
    one_of,
    positive,
    whole,
)
from skillweave.algorithms.schedules import Linear, check_rate, is_schedule
from skillweave.arguments import checked_names
from skillweave.networks.config import Network


@checked_names
@dataclass(frozen=True)
class OnPolicy:
    """What the algorithms that learn from their own latest rollout have in common.

    Raises:
        SkillweaveError: a setting is wrong or out of its range; the message names it.
    """

    num_envs: int = 64
    """Environments stepped side by side."""
    n_steps: int = 64
    """Environment steps of each environment between updates, for selectors too."""
    learning_rate: float | Linear | Callable[[float], float] = 1e-3
    """Adam\'s step size, at the start; or ``Linear(start, end)``, or a function of the share of the
    budget that remains, 1 at the start and 0 at the end, as in Stable-Baselines3."""
    gamma: float = 0.995
    """Discount γ of one step."""
    normalize_obs: bool = True
    """Running zero mean, unit deviation of observations; saved with the policy."""
    network: Network = field(default_factory=Network)
    """The actor's network."""
    overlap: bool = True
    """Collect the next rollout while learning from the last: the data is one update old."""
    threads: int = 1
    """Torch threads while learning."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where learning runs; auto: on a GPU where there is one. Acting runs on the CPU."""

    def __post_init__(self) -> None:
        check_networks(self)
        flags(self)
        whole(self, "num_envs", "n_steps", "threads")
        number(self, "gamma", high=1.0)
        check_rate(self)
        if not is_schedule(self.learning_rate):
            positive(self, "learning_rate")
        one_of(self, "device", ("cpu", "cuda", "auto"))


@checked_names
@dataclass(frozen=True)
class PPO(OnPolicy):
    """Proximal policy optimisation (Schulman et al. 2017).

    Raises:
        SkillweaveError: a setting is wrong or out of its range; the message names it.
    """

    batch_size: int = 256
    """Samples of one gradient step (a minibatch), about; a smaller rollout is one minibatch."""
    update_epochs: int = 10
    """Passes over each rollout."""
    learning_rate_schedule: Literal["constant", "linear", "kl"] = "linear"
    """constant; linear: falls to 0 over the budget; kl: follows target_kl. Counts where
    ``learning_rate`` is a number."""
    adam_eps: float = 1e-5
    """Adam's ε."""
    gae_lambda: float = 0.95
    """λ of generalised advantage estimation."""
    clip_coef: float = 0.2
    """ε of the clipped surrogate."""
    clip_value: float | None = None
    """How far a value may move per update, in units of normalised returns; None: freely."""
    ent_coef: float = 0.01
    """Weight of the entropy bonus, and of the cost of bounded actions' deviations beyond 1."""
    ent_coef_final: float | None = None
    """Weight of the entropy bonus at the end of the budget, reached linearly; None: constant."""
    epsilon: float = 0.0
    """Share of discrete actions drawn uniformly from the allowed ones, at the start."""
    epsilon_final: float | None = None
    """The value that epsilon falls to, linearly; None: constant."""
    epsilon_fraction: float = 1.0
    """Share of the budget over which epsilon falls."""
    vf_coef: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 0.5
    """Gradients are scaled down to this norm."""
    target_kl: float | None = None
    """KL at which an update stops early, or that the 'kl' schedule aims at."""
    normalize_advantage: bool = True
    """Zero mean, unit deviation of the advantages of each update."""
    min_advantage_std: float = 0.05
    """Advantages to normalise that have a smaller deviation, in units of reward, are divided by
    this: where hardly anything was won yet, they are the critic's errors. 0: no limit."""
    normalize_returns: bool = True
    """The critic learns returns in units of their running deviation, so rewards may be large."""
    action_std_init: float = 0.6
    """Initial standard deviation of continuous actions, where a bounded range spans [−1, 1]."""
    action_std: Literal["parameter", "state"] = "parameter"
    """The deviation is a parameter of its own, or depends on the state."""
    squash_actions: bool = False
    """Continuous actions go through tanh, else they are clipped to the bounds."""
    critic: Network | None = None
    """The critic's network; None: as the actor's."""
    compile: bool | Literal["auto"] = False
    """Gradient steps are compiled (``torch.compile``): about twice as fast, after half a minute;
    auto: where that is possible. Weights differ in their last bits, also of a run that was stopped
    and goes on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        compiles(self)
        whole(self, "batch_size", "update_epochs")
        number(self, "gae_lambda", high=1.0)
        positive(self, "clip_coef", "max_grad_norm", "action_std_init", "adam_eps")
        number(self, "ent_coef", "vf_coef", "min_advantage_std")
        number(self, "epsilon", "epsilon_fraction", high=1.0)
        for name in ("ent_coef_final", "epsilon_final"):
            if getattr(self, name) is not None:
                number(self, name, high=1.0 if name == "epsilon_final" else math.inf)
        positive(self, *(k for k in ("target_kl", "clip_value") if getattr(self, k) is not None))
        one_of(self, "action_std", ("parameter", "state"))
        if self.learning_rate_schedule == "kl":
            check(self, "target_kl", self.target_kl is not None, "set for the schedule 'kl'")
        one_of(self, "learning_rate_schedule", ("constant", "linear", "kl"))
        if self.network.rnn is not None:
            check(self, "critic", self.critic is None, "None where network.rnn is set")
            check(self, "compile", self.compile is not True, "False where network.rnn is set")
        rollout = self.num_envs * self.n_steps
        most = max(rollout, PPO.batch_size)  # a small rollout alone is no mistake
        says = f"at most {most}; a rollout has num_envs·n_steps ({rollout}) samples"
        check(self, "batch_size", self.batch_size <= most, says)


@checked_names
@dataclass(frozen=True)
class SelfImitationPPO(PPO):
    """PPO that learns again from what it once did well (Oh et al. 2018, "Self-Imitation Learning").

    For rewards that come seldom: PPO learns once from each, and may forget it until the next comes.
    Here further gradient steps follow each update, on rows of before whose return was more than
    the critic expects. Only trajectories that terminated within a rollout count: of others it is
    not known what they were paid. Where chance decides what is paid, it imitates luck, too.

    Raises:
        SkillweaveError: a setting is wrong or out of its range; the message names it.
    """

    imitation_rows: int = 4096
    """Rows that are kept, the latest."""
    imitation_steps: int = 8
    """The most gradient steps on kept rows after each update, each on ``batch_size`` of them; they
    are fewer where one pass over what is kept takes fewer."""
    imitation_coef: float = 1.0
    """Weight of their policy loss."""
    imitation_vf_coef: float = 0.01
    """Weight of their value loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        whole(self, "imitation_rows", "imitation_steps")
        number(self, "imitation_coef", "imitation_vf_coef")
        check(self, "network", self.network.rnn is None, "without rnn: kept rows have no memory")


@checked_names
@dataclass(frozen=True)
class SkillCritic(OnPolicy):
    """What each skill is worth to the task, Q(s, skill), learnt from every step of all."""

    batch_size: int = 256
    """Samples of one gradient step, about."""
    update_epochs: int = 2
    """Passes over each rollout."""
    gae_lambda: float = 0.95
    """λ of the returns that it learns."""
    adam_eps: float = 1e-5
    """Adam's ε."""
    max_grad_norm: float = 0.5
    """Gradients are scaled down to this norm."""
    deciding: bool = False
    """It also learns what it is worth to decide anew, which interruption asks for."""
    min_advantage_std: float = 0.05
    """The task's advantages of a smaller deviation, in units of reward, are divided by this."""
    epsilon: float = 0.0
    """Share of calls that the selector draws uniformly at the start, to try skills. Few of them are
    cut: while skills learn, what skills are worth is multiplied by 1 − epsilon."""
    epsilon_final: float | None = None
    """The value that epsilon falls to, linearly; None: constant."""
    epsilon_fraction: float = 1.0
    """Share of the budget over which epsilon falls."""

    def __post_init__(self) -> None:
        super().__post_init__()
        whole(self, "batch_size", "update_epochs")
        number(self, "gae_lambda", high=1.0)
        number(self, "epsilon", "epsilon_fraction", high=1.0)
        number(self, "min_advantage_std")
        if self.epsilon_final is not None:
            number(self, "epsilon_final", high=1.0)
        positive(self, "max_grad_norm", "adam_eps")
