"""Settings of the algorithms that learn from their own latest rollout.

Stands alone because ``config`` is the sum of two tables of settings, this and
``config_off_policy``. Does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from skillweave.algorithms.schedules import LearningRate, check_rate
from skillweave.networks.config import Network, check_critic
from skillweave.settings import (
    AtLeastOne,
    Fraction,
    NonNegative,
    Positive,
    check,
    checked_settings,
)


@checked_settings
@dataclass(frozen=True)
class OnPolicy:
    """Settings that all algorithms share that learn from their own latest rollout.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    num_envs: AtLeastOne = 64
    """Environments stepped side by side."""
    n_steps: AtLeastOne = 64
    """Environment steps of each environment between updates, for selectors too."""
    learning_rate: LearningRate = 1e-3
    """Adam\'s step size, at the start; or ``Linear(start, end)``, or a function of the share of the
    budget that remains, 1 at the start and 0 at the end, as in Stable-Baselines3."""
    gamma: Fraction = 0.995
    """Discount γ of one step."""
    normalize_obs: bool = True
    """Running zero mean, unit deviation of observations; saved with the policy."""
    network: Network = field(default_factory=Network)
    """The actor's network."""
    overlap: bool = True
    """Collect the next rollout while learning from the last: the data is one update old."""
    threads: AtLeastOne = 1
    """Torch threads while learning."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Device of learning; auto: a GPU if available. Acting runs on the CPU."""

    def __post_init__(self) -> None:
        check_critic(self)
        check_rate(self)


@checked_settings
@dataclass(frozen=True)
class PPO(OnPolicy):
    """Proximal policy optimisation (Schulman et al. 2017).

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    batch_size: AtLeastOne = 256
    """Approximate samples of a gradient step (a minibatch); a smaller rollout is one minibatch."""
    update_epochs: AtLeastOne = 10
    """Passes over each rollout."""
    learning_rate_schedule: Literal["constant", "linear", "kl"] = "linear"
    """constant; linear: falls to 0 over the budget; kl: follows target_kl. Counts where
    ``learning_rate`` is a number."""
    adam_eps: Positive = 1e-5
    """Adam's ε."""
    gae_lambda: Fraction = 0.95
    """λ of generalised advantage estimation."""
    clip_coef: Positive = 0.2
    """ε of the clipped surrogate."""
    clip_value: Positive | None = None
    """Largest change of a value per update, in units of normalised returns; None: no limit."""
    ent_coef: NonNegative = 0.01
    """Weight of the entropy bonus, and of the cost of bounded actions' deviations beyond 1."""
    ent_coef_final: NonNegative | None = None
    """Weight of the entropy bonus at the end of the budget, reached linearly; None: constant."""
    epsilon: Fraction = 0.0
    """Share of discrete actions drawn uniformly from the allowed ones, at the start."""
    epsilon_final: Fraction | None = None
    """The value that epsilon falls to, linearly; None: constant."""
    epsilon_fraction: Fraction = 1.0
    """Share of the budget over which epsilon falls."""
    vf_coef: NonNegative = 0.5
    """Weight of the value loss."""
    max_grad_norm: Positive = 0.5
    """Gradients are scaled down to this norm."""
    target_kl: Positive | None = None
    """KL at which an update stops early, or that the 'kl' schedule aims at."""
    normalize_advantage: bool = True
    """Zero mean, unit deviation of the advantages of each update."""
    min_advantage_std: NonNegative = 0.05
    """Least divisor of normalised advantages, in units of reward. While rewards are still rare,
    smaller deviations are only the critic's errors. 0: no limit."""
    normalize_returns: bool = True
    """The critic learns returns in units of their running deviation, so rewards may be large."""
    action_std_init: Positive = 0.6
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
        if self.learning_rate_schedule == "kl":
            check(self, "target_kl", self.target_kl is not None, "set for the schedule 'kl'")
        if self.network.rnn is not None:
            check(self, "critic", self.critic is None, "None where network.rnn is set")
            check(self, "compile", self.compile is not True, "False where network.rnn is set")
        rollout = self.num_envs * self.n_steps
        most = max(rollout, PPO.batch_size)  # a small rollout alone is no mistake
        rule = f"at most {most}; a rollout has num_envs·n_steps ({rollout}) samples"
        check(self, "batch_size", self.batch_size <= most, rule)


@checked_settings
@dataclass(frozen=True)
class SelfImitationPPO(PPO):
    """PPO that learns again from its good past steps (Oh et al. 2018, "Self-Imitation Learning").

    For rare rewards: PPO learns once from each, and may forget it before the next comes. Here each
    update is followed by further gradient steps on earlier rows whose return exceeds the critic's
    value. Only trajectories that terminated within a rollout count: the return of others is
    unknown. Where rewards are random, it also imitates luck.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    imitation_rows: AtLeastOne = 4096
    """The latest good rows that are kept."""
    imitation_steps: AtLeastOne = 8
    """The most gradient steps on kept rows after each update, each on ``batch_size`` rows; at most
    one pass over the kept rows."""
    imitation_coef: NonNegative = 1.0
    """Weight of the imitation's policy loss."""
    imitation_vf_coef: NonNegative = 0.01
    """Weight of the imitation's value loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self,
            "network",
            self.network.rnn is None,
            "without rnn: kept rows have no recurrent state",
        )


@checked_settings
@dataclass(frozen=True)
class SkillCritic(OnPolicy):
    """Settings of the critic of skills: Q(s, skill) of the task, learnt from every step."""

    batch_size: AtLeastOne = 256
    """Approximate samples of one gradient step."""
    update_epochs: AtLeastOne = 2
    """Passes over each rollout."""
    gae_lambda: Fraction = 0.95
    """λ of the returns that the critic learns."""
    adam_eps: Positive = 1e-5
    """Adam's ε."""
    max_grad_norm: Positive = 0.5
    """Gradients are scaled down to this norm."""
    deciding: bool = False
    """Also learn the value of deciding again, which interruption needs."""
    min_advantage_std: NonNegative = 0.05
    """Least divisor of the task's normalised advantages, in units of reward."""
    epsilon: Fraction = 0.0
    """Share of calls that the selector draws uniformly at the start, to try skills. Few of these
    are interrupted: while skills learn, their values are multiplied by 1 − epsilon."""
    epsilon_final: Fraction | None = None
    """The value that epsilon falls to, linearly; None: constant."""
    epsilon_fraction: Fraction = 1.0
    """Share of the budget over which epsilon falls."""
