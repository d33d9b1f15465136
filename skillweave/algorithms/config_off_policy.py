"""Settings of the algorithms that learn from a replay buffer.

This module does not import torch; see ``config``, which has the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from skillweave.algorithms.config_checks import (
    INFINITY,
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
from skillweave.errors import SkillweaveError
from skillweave.networks.config import Network

Schedule = Literal["constant", "linear"]


@checked_names
@dataclass(frozen=True)
class OffPolicy:
    """What the algorithms that learn from a replay buffer have in common."""

    num_envs: int = 8
    """Environments stepped side by side."""
    train_freq: int = 1
    """Steps of each environment between updates."""
    update_ratio: float = 1.0
    """Gradient steps per transition collected (the update-to-data ratio)."""
    buffer_size: int = 1_000_000
    """Transitions that the replay buffer holds."""
    learning_starts: int = 5_000
    """Environment steps taken by acting at random before the first gradient step."""
    batch_size: int = 256
    """Samples of one gradient step."""
    n_step: int = 1
    """Steps of reward in a target before it bootstraps (Sutton 1988)."""
    prioritized: bool = False
    """Sample by the size of the last error (Schaul et al. 2016)."""
    priority_alpha: float = 0.6
    """How strongly priorities count; 0: not at all."""
    priority_beta: float = 0.4
    """Correction of the bias that they bring, at the start; 1 at the end of the budget."""
    learning_rate: float | Linear | Callable[[float], float] = 3e-4
    """Adam\'s step size, at the start; or ``Linear(start, end)``, or a function of the share of the
    budget that remains, 1 at the start and 0 at the end, as in Stable-Baselines3."""
    learning_rate_schedule: Schedule = "constant"
    """constant; linear: falls to 0 over the budget. Counts where ``learning_rate`` is a number."""
    adam_eps: float = 1e-8
    """Adam's ε."""
    gamma: float = 0.99
    """Discount γ of one step."""
    tau: float = 0.005
    """Share of the new weights in the target's at each target update."""
    max_grad_norm: float | None = None
    """Gradients are scaled down to this norm; None: they are not."""
    normalize_obs: bool = False
    """Running zero mean, unit deviation of observations; saved with the policy."""
    normalize_rewards: bool = False
    """Rewards are divided by the running deviation of returns."""
    network: Network = field(default_factory=lambda: Network((256, 256), "relu"))
    """The network that acts."""
    save_buffer: bool = True
    """Checkpoints hold the replay buffer, so that resuming is exact; else it fills anew."""
    overlap: bool = False
    """Collect while learning, with the parameters of one update before: pays where environments
    are slow. The lag is ``train_freq`` steps of every environment. Where several learn together,
    only if all of them have it."""
    action_repeat: float = 0.0
    """Chance that an environment, somewhere in ``action_repeat_steps`` of its steps, repeats one
    random action (as in εz-greedy exploration, Dabney et al. 2021). It finds what needs patience,
    like resting on the ground with the engines off. Falls to 0 over the budget. Only where it acts
    in every step: for plain agents, and skills that learn apart."""
    action_repeat_steps: int = 60
    """Steps of the longest repetition; shorter ones are as likely."""
    threads: int = 1
    """Torch threads while learning."""
    compile: bool | Literal["auto"] = False
    """Gradient steps are compiled (``torch.compile``): about twice as fast, after half a minute;
    auto: where that is possible. Weights differ in their last bits, also of a run that was stopped
    and goes on."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where learning runs; auto: on a GPU where there is one. Acting runs on the CPU."""

    def __post_init__(self) -> None:
        check_networks(self)
        flags(self)
        compiles(self)
        check(self, "network", self.network.rnn is None, "without rnn: only PPO has memory")
        whole(self, "num_envs", "train_freq", "buffer_size", "batch_size", "n_step", "threads")
        whole(self, "action_repeat_steps")
        number(self, "gamma", "tau", "priority_alpha", "priority_beta", "action_repeat", high=1.0)
        check_rate(self)
        if not is_schedule(self.learning_rate):
            positive(self, "learning_rate")
        positive(self, "adam_eps", "update_ratio")
        if self.max_grad_norm is not None:
            positive(self, "max_grad_norm")
        number(self, "learning_starts")
        check(self, "learning_starts", type(self.learning_starts) is int, "a whole number")
        one_of(self, "learning_rate_schedule", ("constant", "linear"))
        one_of(self, "device", ("cpu", "cuda", "auto"))
        check(self, "batch_size", self.batch_size <= 1_000_000, "at most 1,000,000")
        least = self.num_envs * (self.n_step + 1)
        check(
            self,
            "buffer_size",
            self.buffer_size >= least,
            f"at least {least} (num_envs·(n_step+1))",
        )


@checked_names
@dataclass(frozen=True)
class DQN(OffPolicy):
    """Deep Q-learning (Mnih et al. 2015) and its extensions; all of them are ``DQN.rainbow()``.

    Raises:
        SkillweaveError: a setting is wrong or out of its range; the message names it.
    """

    double: bool = True
    """The online network chooses the target's action (van Hasselt et al. 2016)."""
    dueling: bool = False
    """Value and advantage streams (Wang et al. 2016)."""
    noisy: bool = False
    """Exploration by learnt noise in the weights instead of ε (Fortunato et al. 2018)."""
    distributional: bool = False
    """C51: the distribution of returns on fixed atoms (Bellemare et al. 2017)."""
    n_atoms: int = 51
    """C51's atoms."""
    v_min: float | None = None
    """C51's smallest return; None: −10 times the root mean square of the returns seen so far, in
    units of which it then learns. What lies beyond the atoms is learnt as the last one."""
    v_max: float | None = None
    """C51's largest return; None, as v_min is: 10 times."""
    max_grad_norm: float | None = 10.0
    """Gradients are scaled down to this norm; None: they are not."""
    learning_starts: int = 1_000
    """Environment steps taken by acting at random before the first gradient step."""
    exploration_fraction: float = 0.1
    """Share of the budget over which ε falls."""
    exploration_initial_eps: float = 1.0
    """ε at the start: the share of random actions."""
    exploration_final_eps: float = 0.05
    """ε afterwards."""
    target_update_interval: int = 1
    """Gradient steps between target updates."""
    loss: Literal["huber", "mse"] = "huber"
    """Of the temporal-difference error; C51 has its own. Where errors exceed 1, huber learns their
    median, which a landing that crashes one time in three does not change: mse learns the mean."""

    def __post_init__(self) -> None:
        super().__post_init__()
        exploration = "exploration_fraction", "exploration_initial_eps", "exploration_final_eps"
        number(self, *exploration, high=1.0)
        whole(self, "target_update_interval", "n_atoms")
        check(self, "n_atoms", self.n_atoms >= 2, "at least 2")
        bounds = {"v_min": self.v_min, "v_max": self.v_max}
        number(self, *(name for name, value in bounds.items() if value is not None), low=-INFINITY)
        together = self.v_min is not None or self.v_max is None
        check(self, "v_min", together, f"a finite number where v_max is one ({self.v_max})")
        if self.v_min is not None and self.v_max is None:
            raise SkillweaveError(
                f"DQN.v_max is None where v_min is {self.v_min}; it must be a finite number"
            )
        if self.v_min is not None and self.v_max is not None:
            check(self, "v_max", self.v_max > self.v_min, f"more than v_min ({self.v_min})")
        one_of(self, "loss", ("huber", "mse"))

    @classmethod
    def rainbow(cls, **settings: Any) -> DQN:
        """Every extension at once, as in Rainbow (Hessel et al. 2018); ``settings`` override."""
        everything = {
            "double": True, "dueling": True, "noisy": True, "distributional": True,
            "prioritized": True, "n_step": 3, "priority_alpha": 0.5, "adam_eps": 1.5e-4,
        }  # fmt: skip
        return cls(**{**everything, **settings})


@checked_names
@dataclass(frozen=True)
class ActorCritic(OffPolicy):
    """What TD3 and SAC have in common, and where their defaults are not DQN's."""

    update_ratio: float = 0.5
    """Gradient steps per transition collected (the update-to-data ratio)."""
    learning_rate: float | Linear | Callable[[float], float] = 1e-3
    """Adam\'s step size, at the start; or ``Linear(start, end)``, or a function of the share of the
    budget that remains, 1 at the start and 0 at the end, as in Stable-Baselines3."""
    learning_rate_schedule: Schedule = "linear"
    """constant; linear: falls to 0 over the budget. Counts where ``learning_rate`` is a number."""
    tau: float = 0.01
    """Share of the new weights in the target's at each target update."""
    normalize_obs: bool = True
    """Running zero mean, unit deviation of observations; saved with the policy."""
    action_repeat: float = 0.2
    """As of ``OffPolicy``."""
    network: Network = field(default_factory=lambda: Network((128, 128), "relu"))
    """The network that acts."""
    critic: Network | None = None
    """The critics' network; None: as the actor's."""


@checked_names
@dataclass(frozen=True)
class TD3(ActorCritic):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018)."""

    n_step: int = 3
    """Steps of reward in a target before it bootstraps (Sutton 1988)."""
    exploration_noise: float = 0.2
    """Deviation of the noise on actions, where a bounded range spans [−1, 1]."""
    policy_delay: int = 2
    """Critic updates for each update of the actor and the targets."""
    target_noise: float = 0.2
    """Deviation of the noise on the target's actions."""
    target_noise_clip: float = 0.5
    """Largest noise on the target's actions."""
    twin: bool = True
    """The smaller of two critics is the target's; else there is one critic."""
    actor_rate: float = 0.3
    """The actor's learning rate, as a share of the critics'."""
    action_l2: float = 0.003
    """Cost of the squared outputs of the actor before tanh, as a share of the mean size of values
    (Andrychowicz et al. 2017, appendix A): where values say little, actions stay small."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, "actor_rate")
        number(self, "exploration_noise", "target_noise", "target_noise_clip", "action_l2")
        whole(self, "policy_delay")

    @classmethod
    def ddpg(cls, **settings: Any) -> TD3:
        """DDPG (Lillicrap et al. 2016): one critic, no delay, no noise on targets, one step.

        Actor and critic learn at one rate, no action is repeated, and large outputs cost nothing;
        ``settings`` override.
        """
        plain = {
            "twin": False,
            "policy_delay": 1,
            "target_noise": 0.0,
            "action_repeat": 0.0,
            "n_step": 1,
            "exploration_noise": 0.1,
            "actor_rate": 1.0,
            "action_l2": 0.0,
        }
        return cls(**{**plain, **settings})


@checked_names
@dataclass(frozen=True)
class SAC(ActorCritic):
    """Soft actor-critic (Haarnoja et al. 2018b); for discrete actions Christodoulou 2019."""

    ent_coef: float = 1.0
    """The temperature α; where it is learnt, at the start."""
    learn_ent_coef: bool = True
    """α is learnt, so that the policy's entropy is ``target_entropy``."""
    target_entropy: float | None = None
    """Entropy aimed at, in nats; None: −A for A continuous actions, half of log A for A discrete
    ones. Where a mask allows m of A discrete actions, it is this times log m / log A."""
    policy_delay: int = 1
    """Critic updates for each update of the actor."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, "ent_coef")
        whole(self, "policy_delay")
        if self.target_entropy is not None:
            number(self, "target_entropy", low=-INFINITY)
