"""Settings of every algorithm: frozen dataclasses, one string under each field.

The command line, the run's JSON and the documentation are generated from these. This module
does not import torch, so that ``--help`` and argument errors are instant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal, Self, TypeAlias

import gymnasium as gym

from skillweave._internal.messages import suggest
from skillweave._internal.named import Named
from skillweave.algorithms.schedules import LearningRate, check_rate
from skillweave.errors import DeclarationError, EnvError, RunError
from skillweave.networks.config import Network, check_critic
from skillweave.policies.untrusted import shown
from skillweave.schema import (
    Amount,
    AtLeastOne,
    Check,
    Count,
    Fraction,
    NonNegative,
    Positive,
    Threads,
    check,
    fit,
    settings,
    to_json,
)

MOST_ROWS = 1_000_000_000
"""The most steps that a buffer holds."""
Rows = Annotated[int, Check(f"at least 1 and at most {MOST_ROWS:,}", lambda x: 1 <= x <= MOST_ROWS)]
"""A number of steps that are held in memory."""


@settings
class OnPolicy:
    """Settings that all algorithms share that learn from their own latest rollout.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    num_envs: Amount = 32
    """Environments stepped side by side."""
    n_steps: Amount = 64
    """Environment steps of each environment between updates, for selectors too."""
    learning_rate: LearningRate = 3e-3
    """Adam's step size, at the start; or ``Linear(start, end)``, or a function of the share of the
    budget that remains, 1 at the start and 0 at the end, as in Stable-Baselines3."""
    gamma: Fraction = 0.995
    """Discount γ of one step."""
    normalize_obs: bool = True
    """Running zero mean, unit deviation of observations; saved with the policy."""
    network: Network = field(default_factory=Network)
    """The actor's network."""
    overlap: bool = True
    """Collect the next rollout while learning from the last: the data is one update old."""
    threads: Threads = 1
    """Torch threads while learning."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Device of learning; auto: a GPU if available. Acting runs on the CPU."""

    def __post_init__(self) -> None:
        check_critic(self)
        check_rate(self)

    def learning_on(self, *, continuous: bool) -> Self:
        """Return the settings by which a learner goes on from a policy that was given: these.

        Args:
            continuous: some numbers of an action are continuous.
        """
        return self


@settings
class PPO(OnPolicy):
    """Proximal policy optimisation (Schulman et al. 2017).

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    batch_size: AtLeastOne | None = None
    """Approximate samples of a gradient step (a minibatch); a smaller rollout is one minibatch.
    None: an eighth of num_envs * n_steps, at least 64."""
    update_epochs: Amount = 5
    """Passes over each rollout."""
    learning_rate_schedule: Literal["constant", "linear", "kl"] = "linear"
    """constant; linear: falls to 0 over the budget; kl: begins at ``learning_rate``, and follows
    target_kl: after each minibatch it is divided by 1.5 where the update has a KL above twice the
    target, and multiplied below half of it, to at most ten times ``learning_rate``. Where a policy
    was given, see ``learning_on``. Counts where ``learning_rate`` is a number."""
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
    a later process waits for a few seconds. auto: after 20,000 gradient steps, where it is
    possible, so that short trainings do not wait. Weights differ in their last bits, also of a run
    that was stopped and goes on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learning_rate_schedule == "kl":
            check(self, "target_kl", self.target_kl is not None, "set for the schedule 'kl'")
        if self.network.rnn is not None:
            check(self, "critic", self.critic is None, "None where network.rnn is set")
            check(self, "compile", self.compile is not True, "False where network.rnn is set")
        rollout = self.num_envs * self.n_steps
        most = max(rollout, 256)  # a small rollout alone is no mistake
        rule = f"at most {most}; a rollout has num_envs * n_steps ({rollout}) samples"
        check(self, "batch_size", self.minibatch <= most, rule)

    @property
    def minibatch(self) -> int:
        """The approximate samples of a gradient step."""
        return self.batch_size or max(64, self.num_envs * self.n_steps // 8)

    def learning_on(self, *, continuous: bool) -> Self:
        """Return the settings by which a learner goes on from a policy that was given.

        A policy that can do something is kept by small steps: the learning rate begins at 1e-4 and
        follows a KL of 0.01, and no bonus widens continuous actions. A setting that is not its
        default stays; ``learning_rate=Linear(3e-3, 0)`` is the usual rate.

        Args:
            continuous: some numbers of an action are continuous.
        """
        usual = {f.name: f.default for f in fields(self)}
        changes: dict[str, Any] = {}
        rate = self.learning_rate, self.learning_rate_schedule
        if rate == (usual["learning_rate"], usual["learning_rate_schedule"]):
            target = 0.01 if self.target_kl is None else self.target_kl
            changes = {"learning_rate": 1e-4, "learning_rate_schedule": "kl", "target_kl": target}
        if continuous and self.ent_coef == usual["ent_coef"] and self.ent_coef_final is None:
            changes["ent_coef"] = 0.0
        return replace(self, **changes)


@settings
class SelfImitationPPO(PPO):
    """PPO that learns again from its good past steps (Oh et al. 2018, "Self-Imitation Learning").

    For rare rewards: PPO learns once from each, and may forget it before the next comes. Here each
    update is followed by further gradient steps on earlier rows whose return exceeds the critic's
    value. Only trajectories that terminated within a rollout count: the return of others is
    unknown. Where rewards are random, it also imitates luck.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    imitation_rows: Rows = 4096
    """The latest good rows that are kept."""
    imitation_steps: Amount = 8
    """The most gradient steps on kept rows after each update, each on as many rows as a minibatch
    has; at most one pass over the kept rows."""
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


@settings
class SkillCritic(OnPolicy):
    """Settings of the critic of skills: Q(s, skill) of the task, learnt from every step."""

    batch_size: AtLeastOne = 256
    """Approximate samples of one gradient step."""
    update_epochs: Amount = 2
    """Passes over each rollout."""
    gae_lambda: Fraction = 0.95
    """λ of the returns that the critic learns."""
    adam_eps: Positive = 1e-5
    """Adam's ε."""
    max_grad_norm: Positive = 0.5
    """Gradients are scaled down to this norm."""
    deciding: bool = False
    """Also learn the value of deciding again, which interruption needs."""
    sees_goals: bool = False
    """Skills have goals: the observation is one of ``with_goal``, with the goals of all skills."""
    min_advantage_std: NonNegative = 0.05
    """Least divisor of the task's normalised advantages, in units of reward."""
    epsilon: Fraction = 0.0
    """Share of calls that the selector draws uniformly at the start, to try skills. Few of these
    are interrupted: while skills learn, their values are multiplied by 1 − epsilon."""
    epsilon_final: Fraction | None = None
    """The value that epsilon falls to, linearly; None: constant."""
    epsilon_fraction: Fraction = 1.0
    """Share of the budget over which epsilon falls."""


Schedule = Literal["constant", "linear"]


@settings
class Hindsight:
    """Hindsight experience replay (Andrychowicz et al. 2017): what was reached becomes the goal.

    A drawn row is judged again, as if its goal had been one that its call has reached.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    n_sampled_goal: AtLeastOne = 4
    """Rows with a goal that was reached, for each with the goal that its call had."""
    goal_selection_strategy: Literal["future", "final", "episode"] = "future"
    """future: reached in this step of the call or a later one; final: in its last step; episode: in
    any of its steps."""

    @property
    def share(self) -> float:
        """Share of drawn rows whose goal is one that was reached."""
        return self.n_sampled_goal / (self.n_sampled_goal + 1)


HindsightValue = Annotated[
    Hindsight | bool,
    Check(
        "True, False or Hindsight()",
        convert=lambda x: Hindsight() if isinstance(x, bool) and x else x,
    ),
]
"""Settings of hindsight; True becomes ``Hindsight()``."""
JUDGES_AGAIN = ("hindsight", "shared_replay")
"""Settings with which rows are judged again when they are drawn."""


@settings
class OffPolicy:
    """Settings that all algorithms with a replay buffer share."""

    num_envs: Amount = 8
    """Environments stepped side by side."""
    train_freq: AtLeastOne = 1
    """Steps of each environment between updates."""
    update_ratio: Positive = 1.0
    """Gradient steps per transition collected (the update-to-data ratio)."""
    buffer_size: Rows = 1_000_000
    """Transitions that the replay buffer holds."""
    learning_starts: Count = 5_000
    """Environment steps taken by acting at random before the first gradient step."""
    batch_size: Amount = 256
    """Samples of one gradient step."""
    n_step: Amount = 1
    """Steps of reward in a target before it bootstraps (Sutton 1988)."""
    prioritized: bool = False
    """Sample by the size of the last error (Schaul et al. 2016)."""
    priority_alpha: Fraction = 0.6
    """Exponent of the priorities; 0: uniform sampling."""
    priority_beta: Fraction = 0.4
    """Exponent that corrects the priorities' bias, at the start; 1 at the end of the budget."""
    learning_rate: LearningRate = 3e-4
    """Adam's step size, at the start; or ``Linear(start, end)``, or a function of the share of the
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
    action_repeat_steps: Amount = 60
    """The longest repetition, in steps; lengths are drawn uniformly."""
    hindsight: HindsightValue = False
    """Learn also from goals that were reached instead (HER): True, or ``Hindsight(...)``. For
    skills with goals that define ``achieved_goal``, and agents in environments of goals."""
    shared_replay: Fraction = 0.0
    """Share of the samples that the learner did not make itself: steps of other skills of the
    hierarchy (SAC-X, Riedmiller et al. 2018), and those of ``data`` (RLPD, Ball et al. 2023). A
    skill judges each by its own reward and ends. 0: it learns from its own steps."""
    threads: Threads = 1
    """Torch threads while learning."""
    compile: bool | Literal["auto"] = False
    """Gradient steps are compiled (``torch.compile``): about twice as fast, after half a minute;
    a later process waits for a few seconds. auto: after 20,000 gradient steps, where it is
    possible, so that short trainings do not wait. Weights differ in their last bits, also of a run
    that was stopped and goes on."""
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
            f"at least {least} (num_envs * (n_step + 1))",
        )
        if judges_again := next((x for x in JUDGES_AGAIN if getattr(self, x)), None):
            check(self, "n_step", self.n_step == 1, f"1 where {judges_again} is set")
            check(self, "prioritized", not self.prioritized, f"False where {judges_again} is set")
        elif is_offline(self):
            check(self, "n_step", self.n_step == 1, "1 where it learns from data alone")
            check(
                self, "prioritized", not self.prioritized, "False where it learns from data alone"
            )

    def learning_on(self, *, continuous: bool) -> Self:
        """Return the settings by which a learner goes on from a policy that was given: these.

        Args:
            continuous: some numbers of an action are continuous.
        """
        return self


@settings
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
    n_atoms: Annotated[
        int, Check("at least 2 and at most 100,000", lambda x: 2 <= x <= 100_000)
    ] = 51
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
        fits = self.v_min is not None or self.v_max is None
        check(self, "v_min", fits, f"a finite number where v_max is one ({self.v_max})")
        fits = self.v_max is not None or self.v_min is None
        check(self, "v_max", fits, f"a finite number where v_min is one ({self.v_min})")
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


@settings
class CQL(DQN):
    """Conservative Q-learning of discrete actions (Kumar et al. 2020), from recorded steps.

    DQN with a cost for values of actions that the data do not show. It learns from ``data`` alone,
    so no environment is stepped, and the steps of its budget are gradient steps.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    online: Fraction = 0.0
    """Share of the budget, at its end, that are steps in the environment: it learns on from them
    and from the data."""
    shared_replay: Fraction = 0.5
    """Share of the samples that are from data, once it steps the environment."""
    cql_alpha: NonNegative = 1.0
    """Weight of the cost, in units of the rewards that it learns; 0: DQN."""
    normalize_rewards: bool = True
    """Rewards are divided by the running deviation of returns."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_data_share(self)


@settings
class ActorCritic(OffPolicy):
    """Settings that TD3, SAC and IQL share, with defaults that differ from DQN's."""

    update_ratio: Positive = 0.5
    """Gradient steps per transition collected (the update-to-data ratio)."""
    learning_rate: LearningRate = 1e-3
    """Adam's step size, at the start; or ``Linear(start, end)``, or a function of the share of the
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


@settings
class TD3(ActorCritic):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018)."""

    n_step: Amount = 3
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


@settings
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

    def learning_on(self, *, continuous: bool) -> Self:
        """Return the settings by which a learner goes on from a policy that was given.

        A learnt α begins at 0.1, unless ``ent_coef`` is not its default: at 1 entropy would be
        worth more than what the policy can do.

        Args:
            continuous: some numbers of an action are continuous.
        """
        usual = {f.name: f.default for f in fields(self)}
        begins_high = self.learn_ent_coef and self.ent_coef == usual["ent_coef"]
        return replace(self, ent_coef=0.1) if begins_high else self


@settings
class IQL(ActorCritic):
    """Implicit Q-learning (Kostrikov et al. 2022), from recorded steps.

    The critics never judge an action that the data do not show, and the policy imitates actions
    the more, the better they are than the state's value. It learns from ``data`` alone, so no
    environment is stepped, and the steps of its budget are gradient steps.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    online: Fraction = 0.0
    """Share of the budget, at its end, that are steps in the environment: it learns on from them
    and from the data."""
    shared_replay: Fraction = 0.5
    """Share of the samples that are from data, once it steps the environment."""
    expectile: Fraction = 0.7
    """The expectile of action values that a state's value is: 0.5 their mean under the data, near 1
    the best one that the data show."""
    beta: NonNegative = 3.0
    """How much more better actions are imitated: by exp(beta · advantage); 0: cloning."""
    normalize_rewards: bool = True
    """Rewards are divided by the running deviation of returns, so that ``beta`` has one unit."""
    action_repeat: Fraction = 0.0
    """See ``OffPolicy``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "expectile", 0.0 < self.expectile < 1.0, "between 0 and 1")
        _check_data_share(self)


def _check_data_share(config: IQL | CQL) -> None:
    """Check that an algorithm that learns from data can draw from them."""
    draws = config.shared_replay > 0.0 or config.online == 1.0
    check(config, "shared_replay", draws, "above 0, unless online is 1")


def is_offline(config: Any) -> bool:
    """Return whether settings let a learner learn from data alone, at first."""
    return bool(getattr(config, "online", 1.0) < 1.0)


AlgorithmConfig: TypeAlias = OnPolicy | OffPolicy
"""Any algorithm's settings, those of users' own algorithms included."""
AlgorithmSettings: TypeAlias = Annotated[
    AlgorithmConfig, Check("the settings of an algorithm, such as PPO()")
]
"""An algorithm's settings as a field of other settings."""


@dataclass(frozen=True)
class Registration:
    """An algorithm, registered under the name of its settings."""

    config: type[Any]
    """The dataclass of its settings."""
    algorithm: Any
    """Its class, or the path of its class, ``module:class``."""
    action_spaces: tuple[type[gym.Space[Any]], ...]
    """The kinds of action spaces that the algorithm supports."""
    acts: bool = True
    """True if the algorithm can be chosen to act; False if it only serves others."""
    chooses_goals: Literal["no", "discrete", "all"] = "no"
    """The goals of skills that a selector which learns by it can choose."""


_SPACES = gym.spaces
_HOME = "skillweave.algorithms"
_ANY = (_SPACES.Discrete, _SPACES.MultiDiscrete, _SPACES.MultiBinary, _SPACES.Box)
_ALL = (*_ANY, _SPACES.Dict, _SPACES.Tuple)
_REGISTERED: dict[str, Registration] = {
    "PPO": Registration(PPO, f"{_HOME}.ppo:PPOAlgorithm", _ALL, chooses_goals="all"),
    "SelfImitationPPO": Registration(
        SelfImitationPPO, f"{_HOME}.self_imitation:SelfImitationAlgorithm", _ALL
    ),
    "SkillCritic": Registration(
        SkillCritic, f"{_HOME}.skill_critic:SkillCriticAlgorithm", (_SPACES.Discrete,), acts=False
    ),
    "DQN": Registration(
        DQN, f"{_HOME}.dqn:DQNAlgorithm", (_SPACES.Discrete,), chooses_goals="discrete"
    ),
    "CQL": Registration(CQL, f"{_HOME}.cql:CQLAlgorithm", (_SPACES.Discrete,)),
    "TD3": Registration(TD3, f"{_HOME}.td3:TD3Algorithm", (_SPACES.Box,)),
    "SAC": Registration(
        SAC, f"{_HOME}.sac:SACAlgorithm", (_SPACES.Box, _SPACES.Discrete), chooses_goals="discrete"
    ),
    "IQL": Registration(IQL, f"{_HOME}.iql:IQLAlgorithm", (_SPACES.Box, _SPACES.Discrete)),
}
BUILT_IN = tuple(_REGISTERED)
"""Names of the algorithms of this library."""


def add_registration(registration: Registration) -> None:
    """Register an algorithm, in place of an earlier one; see ``registry.register_algorithm``."""
    _REGISTERED[registration.config.__name__] = registration


def own_registrations() -> list[Registration]:
    """Return the algorithms that are not of this library."""
    return [r for name, r in _REGISTERED.items() if name not in BUILT_IN]


def registration_of(config: Any) -> Registration:
    """Return the algorithm that settings belong to.

    Raises:
        DeclarationError: the algorithm was never registered.
    """
    kind = type(config)
    for registration in _REGISTERED.values():
        if registration.config is kind:
            return registration
    raise DeclarationError(_not_registered(kind.__name__))


def _not_registered(name: str) -> str:
    """Return the error message for settings of an algorithm that is not registered."""
    return (
        f"no algorithm is registered for {name}; there are: {', '.join(_REGISTERED)}. An algorithm "
        "of your own must be registered in every process that uses it, before it is used: call "
        "skillweave.algorithms.register_algorithm(its settings, its class) in the file that "
        "defines it, and import that file in your program or recipe"
    )


def check_spaces(config: Any, action_space: gym.Space[Any], where: str = "") -> None:
    """Raise a DeclarationError that names other algorithms if this one cannot act in a space."""
    if (goal_spaces := getattr(action_space, "goal_spaces", None)) is not None:
        _check_goals(config, goal_spaces, where)
        return
    if not _acts_in(registration_of(config), action_space):
        able = [k for k, r in _REGISTERED.items() if r.acts and _acts_in(r, action_space)]
        raise DeclarationError(
            f"{where}{type(config).__name__} cannot act in {action_space}; "
            + (f"{', '.join(able)} can" if able else "no algorithm here can")
        )


def _acts_in(registration: Registration, space: gym.Space[Any]) -> bool:
    """Return whether an algorithm supports an action space.

    Whole numbers of a Box are choices, as those of MultiDiscrete are.
    """
    if isinstance(space, _SPACES.Box) and space.dtype.kind != "f":
        return _SPACES.MultiDiscrete in registration.action_spaces
    return isinstance(space, registration.action_spaces)


def _has_choices_alone(space: gym.Space[Any]) -> bool:
    """Return whether an algorithm for choices alone can choose goals of a space."""
    if isinstance(space, _SPACES.Box) and space.dtype.kind != "f":
        from skillweave.spaces.action_codec import choice_counts  # needs torch

        return bool(choice_counts(space))
    return isinstance(space, _SPACES.Discrete | _SPACES.MultiDiscrete | _SPACES.MultiBinary)


def _check_goals(config: Any, spaces: Mapping[str, gym.Space[Any]], where: str) -> None:
    """Raise a DeclarationError where an algorithm cannot choose goals of these spaces, by skill."""
    able = registration_of(config).chooses_goals
    wrong = [name for name, space in spaces.items() if not _has_choices_alone(space)]
    if able == "discrete" and not wrong:
        return
    if able == "all":
        from skillweave.spaces.action_codec import action_codec  # needs torch

        for name, space in spaces.items():
            try:
                action_codec(space)
            except EnvError:
                raise DeclarationError(
                    f"{where}{type(config).__name__} cannot choose goals of {space}, which {name!r}"
                    " has (goal_space): give it goals of Box (whole numbers with at most 256 "
                    "values each, 10,000 in all), Discrete, MultiDiscrete, MultiBinary, Dict or "
                    "Tuple of these, or a ready selector that returns (names, goals)"
                ) from None
        return
    kind = "goals" if able == "no" else f"goals of {spaces[wrong[0]]}"
    raise DeclarationError(
        f"{where}{type(config).__name__} cannot choose {kind}, but "
        f"{' and '.join(map(repr, wrong or spaces))} needs them (goal_space): let the selector "
        "learn by PPO, or give a ready one that returns (names, goals)"
    )


def named_config(name: str, where: str) -> AlgorithmConfig:
    """Return an algorithm's or a preset's default settings by name, in any case.

    Raises:
        DeclarationError: no algorithm has this name; the message, which begins with ``where``,
            lists them.
    """
    kinds = {name: r.config for name, r in _REGISTERED.items() if r.acts}
    presets: dict[str, Any] = {**kinds, "Rainbow": DQN.rainbow, "DDPG": TD3.ddpg}
    for known, make in presets.items():
        if known.lower() == name.lower():
            config: AlgorithmConfig = make()
            return config
    raise DeclarationError(f"{where}: no algorithm {name!r}{suggest(name, presets)}")


def config_to_json(config: AlgorithmConfig) -> dict[str, Any]:
    """Convert an algorithm's settings to JSON, with its name under ``algorithm``.

    Raises:
        DeclarationError: a setting, of a user's own algorithm, cannot be recorded.
    """
    name = type(config).__name__
    advice = "record a name, and let the algorithm look up what it means"
    return {"algorithm": name, **to_json(config, name, advice)}


def with_networks(config: Any, like: Any) -> Any:
    """Return an algorithm's settings with the networks of others, which may have grown."""
    networks = {k: getattr(like, k) for k in ("network", "critic") if hasattr(like, k)}
    return replace(config, **networks)


def alone(config: Any) -> Any:
    """Return an algorithm's settings with which it learns from its own steps alone."""
    return replace(config, shared_replay=0.0) if getattr(config, "shared_replay", 0.0) else config


def own_encoders(config: Any) -> list[str]:
    """Return the functions of the user that settings need for acting, by name."""
    networks = (getattr(config, name, None) for name in ("network", "critic"))
    return [n.encoder for n in networks if n is not None and isinstance(n.encoder, Named)]


def config_from_json(data: Any, file: str = "", path: str = "") -> AlgorithmConfig:
    """Read an algorithm's settings from the JSON of ``config_to_json``.

    Args:
        file: the file it was read from, for messages.
        path: the field in it: ``stages[0].algorithm``.

    Raises:
        RunError: an unknown algorithm or field, named, or a value of another type or out
            of range.
    """
    values: dict[str, Any] = fit(dict[str, Any], data, file, path)
    kind = values.pop("algorithm", None)
    if not isinstance(kind, str) or kind not in _REGISTERED:
        where = f"{file}: {path}: " if file else ""
        raise RunError(f"{where}{_not_registered(shown(kind))}")
    config: AlgorithmConfig = fit(_REGISTERED[kind].config, values, file, path or kind)
    return config


__all__ = [
    "CQL",
    "DQN",
    "IQL",
    "PPO",
    "SAC",
    "TD3",
    "AlgorithmConfig",
    "OffPolicy",
    "OnPolicy",
    "SelfImitationPPO",
    "SkillCritic",
]
