"""The declaration of a hierarchy: data and checks, no training."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium as gym

from skillweave.algorithms.config import PPO, AlgorithmConfig
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.lengths import Lengths
from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.checks import check_calls, checked_reflexes, checked_skills
from skillweave.hierarchy.fitting import check_settings, fitted_policies, fitted_selectors
from skillweave.hierarchy.guidance import check_selection
from skillweave.hierarchy.nesting import (
    Nestable,
    check_nested,
    every_skill,
    inner_hierarchies,
    inner_of,
)
from skillweave.messages import short
from skillweave.networks.config import seeing_all
from skillweave.selectors import ReadySelector, ready_selector
from skillweave.selectors.ready import ReadyValue
from skillweave.skills import Reflex, Skill
from skillweave.spaces import action_codec, obs_codec
from skillweave.training.plain_agent import (
    AGENT,
    PlainAgent,
    check_algorithm,
    check_env,
    check_fields,
)
from skillweave.training.stage import CRITIC, SELECTOR, Together, target_of
from skillweave.types import Policy, SkillweaveError

TOGETHER = "together"
"""What the stage is named in which all learn together."""
RESERVED = (SELECTOR, CRITIC, TOGETHER, AGENT, "flat")
"""Names of stages that are not skills; "flat" in runs of older versions."""


@dataclass
class Declaration(Nestable):
    """Skills, reflexes and a selector on one environment, with budgets in environment steps.

    Raises:
        SkillweaveError: the declaration is wrong; the message names the skill and the field.
    """

    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec`` for more."""
    skills: Sequence[Skill]
    """What the selector chooses from; a hierarchy among them is trained inside, where it learns
    apart with its own budgets."""
    call_steps: int | Lengths | None = 40
    """How long a skill acts before the selector decides again; None: until it stops by itself."""
    learn: Literal["apart", "together", "apart, then together"] = "apart"
    """Skills one by one, then the selector; or all from the same steps; or first so, then so."""
    reflexes: Sequence[Reflex] = ()
    """Rules that override the running skill's action."""
    algorithm: AlgorithmConfig = field(default_factory=PPO)
    """Trains every skill that names none of its own."""
    selector: AlgorithmConfig | ReadyValue = field(default_factory=PPO)
    """Trains the selector; its γ is that of one environment step, and so its n_steps. Or a ready
    selector, not trained: a function of observations, an ``Automaton``, or a ``tree.Sequence``."""
    guide: ReadyValue | None = None
    """A ready selector that a trained one keeps to."""
    guide_restricts: bool = True
    """Only what the guide may choose is called, in training and afterwards."""
    guide_nats: float | None = None
    """How far from the guide the selector may be while it learns, in nats of KL; None: freely."""
    skill_steps: int = 500_000
    """Training budget of every skill that names none of its own."""
    selector_steps: int = 1_000_000
    """Training budget of the selector, in environment steps; a ready one takes none."""
    start_calls: int | None = None
    """While a skill trains apart, its episodes begin after up to this many calls of the skills that
    can act already, a number drawn for each: it learns where it will be called. None: it starts as
    soon as it may."""
    search_steps: int | None = None
    """While a skill trains apart, an episode begins anew in which it may not start within so many
    steps: for environments of several kinds, where some have nothing for it. None: it goes on."""
    episode_calls: int = 1
    """The most calls of a skill in an episode, while it trains apart. After one that reached its
    ``max_steps`` others are called if ``start_calls`` says so, then the skill again, if it may
    start. 1: each call begins with a reset. Evaluations count an episode's first call."""
    together_steps: int = 1_000_000
    """Training budget of learning together, in environment steps."""
    call_cost: float = 0.0
    """What the selector pays for each decision while it learns, in units of reward, so that calls
    which change nothing are worth less. More than the discounted reward makes long calls best."""
    interrupt: bool = False
    """The selector cuts a call where deciding anew is worth clearly more (``Together.margin``)."""
    together: Together = field(default_factory=Together)
    """How skills and selector learn together."""
    selector_target_return: float | None = None
    """The selector's stage ends early at this mean return of the periodic evaluation."""
    flat: AlgorithmConfig | None = None
    """Trains the flat baseline; None: as ``algorithm``, which then sees the whole observation."""
    flat_steps: int | None = None
    """Training budget of the flat baseline; None: as many steps as the whole hierarchy takes."""
    greedy_skills: bool | None = None
    """True: skills act greedily under the selector. False: they sample, as they do where they learn
    together. None: they are greedy where they learn apart; where they learn together, 100 episodes
    of each kind are played at the end, and the better is kept."""
    reflexes_in_training: bool = True
    """Reflexes are in force while skills train, apart or together: the body they will have."""
    cut_every: int = 100_000
    """Environment steps between checkpoints."""
    eval_every: int | None = None
    """Environment steps between evaluations of who trains, by its own reward; None: none. They are
    ``eval_return`` and ``eval_success`` in ``metrics.jsonl``."""
    eval_episodes: int = 20
    """Episodes of each of these evaluations."""
    name: str = "hierarchy"
    """What it is named where it is a skill of another hierarchy."""
    recorded = False
    """It is of a run that was loaded without its code, and knows less than was declared."""

    def __post_init__(self) -> None:
        check_env(self.env)
        self.skills = checked_skills(self.skills, RESERVED)
        self.reflexes = checked_reflexes(self.reflexes)
        for name in ("algorithm", "flat"):
            check_algorithm(getattr(self, name), name, optional=name == "flat")
        check_selection(self)
        target_of(self.selector_target_return, None, "selector", "selector_target")
        check_fields(self)
        check_calls(self.call_steps, self.skills)
        check_nested(self)
        cost: Any = self.call_cost
        if isinstance(cost, bool) or not isinstance(cost, int | float) or not 0 <= cost < math.inf:
            raise SkillweaveError(
                f"call_cost is {short(cost)}; it must be a number of at least 0, in units of reward"
            )
        if not isinstance(self.together, Together):
            raise SkillweaveError(
                f"together is {short(self.together)}; write together=Together(task_weight=1.0)"
            )

    @property
    def spec(self) -> EnvSpec:
        """The environment, fully specified."""
        return self.env if isinstance(self.env, EnvSpec) else EnvSpec(self.env)

    @property
    def is_data(self) -> bool:
        """Whether acting needs none of the user's Python code, so a saved run says it all."""
        code = any(s.defines("termination") or s.defines("initiation") for s in self.skills)
        plain = (inner.is_data if (inner := inner_of(s)) else s.policy is None for s in self.skills)
        ready = self.ready_selector is not None or not all(plain)
        own = bool(self.reflexes) or self.guide is not None
        return not code and not ready and not own and self.spec.is_data

    @property
    def trains_from_data(self) -> bool:
        """Whether training, too, needs none of the user's Python code."""
        own = any(s.defines(m) for _, s in every_skill(self.skills) for m in s.methods)
        return self.is_data and self.spec.engine == "auto" and not own

    def skill(self, name: str) -> Skill:
        """The skill of this ``name``, or path.

        Raises:
            SkillweaveError: there is none; the message lists them.
        """
        found = dict(every_skill(self.skills))
        if not isinstance(name, str) or name not in found:
            raise SkillweaveError(f"no skill {short(name)}; there are: {', '.join(found)}")
        return found[name]

    def budget(self, skill: Skill) -> int:
        """Training steps of a ``skill``, of a hierarchy all; 0 where its policy is ready."""
        if (inner := inner_of(skill)) is not None:
            return inner.total_steps
        return 0 if skill.policy is not None else skill.steps or self.skill_steps

    @property
    def choices(self) -> int:
        """Of how many a selector's choice is one: skills, times lengths if these are chosen."""
        lengths = self.call_steps.steps if isinstance(self.call_steps, Lengths) else (0,)
        return len(self.skills) * len(lengths)

    def chooses_from(self, path: str, actions: gym.Space[Any]) -> gym.Space[Any]:
        """What a selector, its critic or a skill at ``path`` chooses from, given ``actions``."""
        node, _, name = path.rpartition("/")
        if name not in (SELECTOR, CRITIC):
            return actions
        inner = inner_of(self.skill(node)) if node else self
        assert inner is not None
        return gym.spaces.Discrete(inner.choices if name == SELECTOR else len(inner.skills))

    @property
    def total_steps(self) -> int:
        """All training steps of skills and selector: the flat baseline's budget."""
        selector = self.selector_steps if self.ready_selector is None else 0
        apart = sum(self.budget(s) for s in self.skills) + selector
        return (apart if self.learns_apart else 0) + (self.together_steps if self.weaves else 0)

    @property
    def learns_apart(self) -> bool:
        """Whether there are stages in which one learns by itself."""
        return self.learn != "together"

    @property
    def weaves(self) -> bool:
        """Whether there is a stage in which all learn together."""
        return self.learn != "apart"

    def scale(self, factor: float) -> None:
        """Multiply every training budget by ``factor``, in place.

        Raises:
            SkillweaveError: the factor is not positive and finite.
        """
        if not 0.0 < factor < float("inf"):
            raise SkillweaveError(f"scale is {factor}; it must be positive and finite")
        for _, inner in inner_hierarchies(self.skills):
            inner.scale(factor)
        for skill in self.skills:
            if skill.steps is not None:
                skill.steps = max(1, round(skill.steps * factor))
        self.skill_steps = max(1, round(self.skill_steps * factor))
        self.selector_steps = max(1, round(self.selector_steps * factor))
        self.together_steps = max(1, round(self.together_steps * factor))
        if self.flat_steps is not None:
            self.flat_steps = max(1, round(self.flat_steps * factor))

    def plain_agent(self) -> PlainAgent:
        """The flat baseline: one agent on the task itself, without skills and reflexes."""
        if not (self.flat_steps or self.total_steps):
            raise SkillweaveError(
                "nothing of this hierarchy is trained, so the flat baseline has no budget: give "
                "flat_steps"
            )
        return PlainAgent(
            self.env,
            self.flat or seeing_all(self.algorithm),
            self.flat_steps or self.total_steps,
            cut_every=self.cut_every,
            eval_every=self.eval_every,
            eval_episodes=self.eval_episodes,
        )

    def skill_set(
        self, policies: Sequence[Policy], skills: Sequence[Skill] | None = None
    ) -> SkillSet:
        """The ``skills`` (None: all) with their ``policies``, ready to be called."""
        return SkillSet(
            tuple(self.skills if skills is None else skills),
            tuple(policies),
            tuple(self.reflexes),
            self.call_steps,
            self.greedy_skills is not False,
            self.call_cost,
        )

    def check_spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        """Make the environment once; its observation space and action space.

        Raises:
            SkillweaveError: something does not fit it.
        """
        env = self.spec.make()
        try:
            obs_codec(env.observation_space)
            action_codec(env.action_space)
            check_settings(self, env)
            fitted_policies(self, env)
            fitted_selectors(self, env.observation_space)
            return env.observation_space, env.action_space
        finally:
            env.close()

    @property
    def ready_selector(self) -> ReadySelector | None:
        """The selector that is not trained; None: it is."""
        return ready_selector(self.selector, tuple(s.name for s in self.skills))

    def ready_selectors(self) -> dict[str, Policy]:
        """By path, the selectors that are not trained, on the environment's observations."""
        hierarchies = (self, *(inner_of(s) for _, s in every_skill(self.skills)))
        if all(h is None or h.ready_selector is None for h in hierarchies):
            return {}
        with closing(self.spec.make()) as env:
            return fitted_selectors(self, env.observation_space)

    def ready_policies(self) -> dict[str, Policy]:
        """By path, the policies of skills that are not trained, on the environment's spaces."""
        if all(s.policy is None for s in self.skills):
            return {}
        with closing(self.spec.make()) as env:
            return fitted_policies(self, env)
