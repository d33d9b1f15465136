"""Settings of the algorithms that learn from a replay buffer.

Stands alone because ``config`` is the sum of two tables of settings, this and
``config_on_policy``. Does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from skillweave.algorithms.schedules import LearningRate, check_rate
from skillweave.networks.config import Network, check_critic
from skillweave.settings import (
    AtLeastOne,
    Check,
    Count,
    Fraction,
    NonNegative,
    Positive,
    check,
    checked_settings,
)

Schedule = Literal["constant", "linear"]


@checked_settings
@dataclass(frozen=True)
class OffPolicy:
    """Settings that all algorithms with a replay buffer share."""

    num_envs: AtLeastOne = 8
    """Environments stepped side by side."""
    train_freq: AtLeastOne = 1
    """Steps of each environment between updates."""
    update_ratio: Positive = 1.0
    """Gradient steps per transition collected (the update-to-data ratio)."""
    buffer_size: AtLeastOne = 1_000_000
    """Transitions that the replay buffer holds."""
    learning_starts: Count = 5_000
    """Environment steps taken by acting at random before the first gradient step."""
    batch_size: Annotated[
        int, Check("at least 1 and at most 1,000,000", lambda x: 1 <= x <= 1_000_000)
    ] = 256
    """Samples of one gradient step."""
    n_step: AtLeastOne = 1
    """Steps of reward in a target before it bootstraps (Sutton 1988)."""
    prioritized: bool = False
    """Sample by the size of the last error (Schaul et al. 2016)."""
    priority_alpha: Fraction = 0.6
    """Exponent of the priorities; 0: uniform sampling."""
    priority_beta: Fraction = 0.4
    """Exponent that corrects the priorities' bias, at the start; 1 at the end of the budget."""
    learning_rate: LearningRate = 3e-4
    """Adam\'s step size, at the start; or ``Linear(start, end)``, or a function of the share of the
    budget that remains, 1 at the start and 0 at the end, as in Stable-Baselines3."""
    learning_rate_schedule: Schedule = "constant"
    """constant; linear: falls to 0 over the budget. Counts where ``learning_rate`` is a number."""
    adam_eps: Positive = 1e-8
    """Adam's ε."""
    gamma: Fraction = 0.99
    """Discount γ of one step."""
    tau: Fraction = 0.005
    """Share of the new weights in the target's at each target update."""
    max_grad_norm: Positive | None = None
    """Gradients are scaled down to this norm; None: they are not."""
    normalize_obs: bool = False
    """Running zero mean, unit deviation of observations; saved with the policy."""
    normalize_rewards: bool = False
    """Rewards are divided by the running deviation of returns."""
    network: Network = field(default_factory=lambda: Network((256, 256), "relu"))
    """The network that acts."""
    save_buffer: bool = True
    """Checkpoints hold the replay buffer, so that resuming is exact; else it starts empty."""
    overlap: bool = False
    """Collect while learning, with the parameters of one update before: useful where environments
    are slow. The lag is ``train_freq`` steps of every environment. Where several policies learn
    together, all of them must set it."""
    action_repeat: Fraction = 0.0
    """Probability that an environment, somewhere in ``action_repeat_steps`` of its steps, repeats
    one random action (as in εz-greedy exploration, Dabney et al. 2021). It explores behaviour that
    takes many equal steps, like resting on the ground with the engines off. Falls to 0 over the
    budget. Only for policies that act in every step: plain agents, and skills that learn apart."""
    action_repeat_steps: AtLeastOne = 60
    """The longest repetition, in steps; lengths are drawn uniformly."""
    threads: AtLeastOne = 1
    """Torch threads while learning."""
    compile: bool | Literal["auto"] = False
    """Gradient steps are compiled (``torch.compile``): about twice as fast, after half a minute;
    auto: where that is possible. Weights differ in their last bits, also of a run that was stopped
    and goes on."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Device of learning; auto: a GPU if available. Acting runs on the CPU."""

    def __post_init__(self) -> None:
        check_critic(self)
        check(
            self,
            "network",
            self.network.rnn is None,
            "without rnn: only PPO supports recurrent networks",
        )
        check_rate(self)
        least = self.num_envs * (self.n_step + 1)
        check(
            self,
            "buffer_size",
            self.buffer_size >= least,
            f"at least {least} (num_envs·(n_step+1))",
        )


@checked_settings
@dataclass(frozen=True)
class DQN(OffPolicy):
    """Deep Q-learning (Mnih et al. 2015) and its extensions; all of them are ``DQN.rainbow()``.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    double: bool = True
    """The online network chooses the target's action (van Hasselt et al. 2016)."""
    dueling: bool = False
    """Value and advantage streams (Wang et al. 2016)."""
    noisy: bool = False
    """Exploration by learnt noise in the weights instead of ε (Fortunato et al. 2018)."""
    distributional: bool = False
    """C51: the distribution of returns on fixed atoms (Bellemare et al. 2017)."""
    n_atoms: Annotated[int, Check("at least 2", lambda x: x >= 2)] = 51
    """C51's atoms."""
    v_min: float | None = None
    """C51's smallest return; None: −10 times the root mean square of the returns so far, which is
    then the unit of learning. Returns beyond the atoms are learnt as the last atom."""
    v_max: float | None = None
    """C51's largest return; None, if v_min is None: 10 times the root mean square."""
    max_grad_norm: Positive | None = 10.0
    """Gradients are scaled down to this norm; None: they are not."""
    learning_starts: Count = 1_000
    """Environment steps taken by acting at random before the first gradient step."""
    exploration_fraction: Fraction = 0.1
    """Share of the budget over which ε falls."""
    exploration_initial_eps: Fraction = 1.0
    """ε at the start: the share of random actions."""
    exploration_final_eps: Fraction = 0.05
    """ε afterwards."""
    target_update_interval: AtLeastOne = 1
    """Gradient steps between target updates."""
    loss: Literal["huber", "mse"] = "huber"
    """Loss of the temporal-difference error; C51 has its own. Where errors exceed 1, huber learns
    their median, which rare large errors (a crash in one landing of three) do not change; mse
    learns the mean."""

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.v_min is not None or self.v_max is None
        check(self, "v_min", given, f"a finite number where v_max is one ({self.v_max})")
        given = self.v_max is not None or self.v_min is None
        check(self, "v_max", given, f"a finite number where v_min is one ({self.v_min})")
        if self.v_min is not None and self.v_max is not None:
            check(self, "v_max", self.v_max > self.v_min, f"more than v_min ({self.v_min})")

    @classmethod
    def rainbow(cls, **settings: Any) -> DQN:
        """Return DQN with all extensions of Rainbow (Hessel et al. 2018); ``settings`` override."""
        everything = {
            "double": True,
            "dueling": True,
            "noisy": True,
            "distributional": True,
            "prioritized": True,
            "n_step": 3,
            "priority_alpha": 0.5,
            "adam_eps": 1.5e-4,
        }
        return cls(**{**everything, **settings})


@checked_settings
@dataclass(frozen=True)
class ActorCritic(OffPolicy):
    """Settings that TD3 and SAC share, with defaults that differ from DQN's."""

    update_ratio: Positive = 0.5
    """Gradient steps per transition collected (the update-to-data ratio)."""
    learning_rate: LearningRate = 1e-3
    """Adam\'s step size, at the start; or ``Linear(start, end)``, or a function of the share of the
    budget that remains, 1 at the start and 0 at the end, as in Stable-Baselines3."""
    learning_rate_schedule: Schedule = "linear"
    """constant; linear: falls to 0 over the budget. Counts where ``learning_rate`` is a number."""
    tau: Fraction = 0.01
    """Share of the new weights in the target's at each target update."""
    normalize_obs: bool = True
    """Running zero mean, unit deviation of observations; saved with the policy."""
    action_repeat: Fraction = 0.2
    """See ``OffPolicy``."""
    network: Network = field(default_factory=lambda: Network((128, 128), "relu"))
    """The network that acts."""
    critic: Network | None = None
    """The critics' network; None: as the actor's."""


@checked_settings
@dataclass(frozen=True)
class TD3(ActorCritic):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018)."""

    n_step: AtLeastOne = 3
    """Steps of reward in a target before it bootstraps (Sutton 1988)."""
    exploration_noise: NonNegative = 0.2
    """Deviation of the noise on actions, where a bounded range spans [−1, 1]."""
    policy_delay: AtLeastOne = 2
    """Critic updates for each update of the actor and the targets."""
    target_noise: NonNegative = 0.2
    """Deviation of the noise on the target's actions."""
    target_noise_clip: NonNegative = 0.5
    """Largest noise on the target's actions."""
    twin: bool = True
    """Use the smaller value of two critics as the target; False: one critic."""
    actor_rate: Positive = 0.3
    """The actor's learning rate, as a share of the critics'."""
    action_l2: NonNegative = 0.003
    """Cost of the squared outputs of the actor before tanh, as a share of the mean size of values
    (Andrychowicz et al. 2017, appendix A): where values hardly differ, actions stay small."""

    @classmethod
    def ddpg(cls, **settings: Any) -> TD3:
        """Return DDPG (Lillicrap et al. 2016): one critic, no delay, no target noise, one step.

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


@checked_settings
@dataclass(frozen=True)
class SAC(ActorCritic):
    """Soft actor-critic (Haarnoja et al. 2018b); for discrete actions Christodoulou 2019."""

    ent_coef: Positive = 1.0
    """The temperature α; if α is learnt, its initial value."""
    learn_ent_coef: bool = True
    """Learn α, so that the policy's entropy is ``target_entropy``."""
    target_entropy: float | None = None
    """The intended entropy, in nats; None: −A for A continuous actions, half of log A for A
    discrete ones. Where a mask allows m of A discrete actions, it is this times log m / log A."""
    policy_delay: AtLeastOne = 1
    """Critic updates for each update of the actor."""
