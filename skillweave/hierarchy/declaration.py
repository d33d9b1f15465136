"""The declaration of a hierarchy: data and checks, no training."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium as gym

from skillweave.algorithms.config import PPO, AlgorithmConfig, check_spaces
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.lengths import Lengths
from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.checks import check_calls, checked_reflexes, checked_skills
from skillweave.hierarchy.guidance import check_selection, fitted_guide
from skillweave.messages import short
from skillweave.selectors import ReadySelector, ready_selector
from skillweave.selectors.ready import ReadyValue
from skillweave.skills import Reflex, Skill, ready_policy
from skillweave.skills.foreign_policy import fitted
from skillweave.spaces import action_codec, obs_codec
from skillweave.training.plain_agent import (
    AGENT,
    PlainAgent,
    check_algorithm,
    check_env,
    check_fields,
    check_rollout,
)
from skillweave.training.stage import CRITIC, SELECTOR, Together, target_of
from skillweave.types import Policy, SkillweaveError

TOGETHER = "together"
"""What the stage is named in which all learn together."""
RESERVED = (SELECTOR, CRITIC, TOGETHER, AGENT, "flat")
"""Names of stages that are not skills; "flat" in runs of older versions."""


@dataclass
class Declaration:
    """Skills, reflexes and a selector on one environment, with budgets in environment steps.

    Raises:
        SkillweaveError: the declaration is wrong; the message names the skill and the field.
    """

    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec`` for more."""
    skills: Sequence[Skill]
    """What the selector chooses from."""
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
    together_steps: int = 1_000_000
    """Training budget of learning together, in environment steps."""
    call_cost: float = 0.0
    """What the selector pays for each decision while it learns, in units of reward: a deliberation
    cost, so that calls which change nothing are not worth as much as others."""
    interrupt: bool = False
    """The selector cuts a call where another skill is clearly worth more (``Together.margin``)."""
    together: Together = field(default_factory=Together)
    """How skills and selector learn together."""
    selector_target_return: float | None = None
    """The selector's stage ends early at this mean return of the periodic evaluation."""
    flat: AlgorithmConfig | None = None
    """Trains the flat baseline; None: as ``algorithm``."""
    flat_steps: int | None = None
    """Training budget of the flat baseline; None: as many steps as the whole hierarchy takes."""
    greedy_skills: bool = True
    """Skills act greedily under the selector; else they sample."""
    reflexes_in_training: bool = True
    """Reflexes are in force while skills train, apart or together: the body they will have."""
    cut_every: int = 100_000
    """Environment steps between checkpoints."""
    eval_every: int | None = None
    """Environment steps between evaluations of who trains, by its own reward; None: none."""
    eval_episodes: int = 20
    """Episodes of each of these evaluations."""

    def __post_init__(self) -> None:
        check_env(self.env)
        self.skills = checked_skills(self.skills, RESERVED)
        self.reflexes = checked_reflexes(self.reflexes)
        for name in ("algorithm", "flat"):
            check_algorithm(getattr(self, name), name, optional=name == "flat")
        check_selection(self)
        target_of(self.selector_target_return, None, "selector")
        check_fields(self)
        check_calls(self.call_steps, self.skills)
        cost: Any = self.call_cost
        if isinstance(cost, bool) or not isinstance(cost, int | float) or not 0 <= cost < math.inf:
            raise SkillweaveError(
                f"call_cost is {short(cost)}; it must be a number of at least 0, in units of reward"
            )
        if not isinstance(self.together, Together):
            raise SkillweaveError(
                f"together is {short(self.together)}; write together=Together(floor=0.3)"
            )

    @property
    def spec(self) -> EnvSpec:
        """The environment, fully specified."""
        return self.env if isinstance(self.env, EnvSpec) else EnvSpec(self.env)

    @property
    def is_data(self) -> bool:
        """Whether acting needs none of the user's Python code, so a saved run says it all."""
        code = any(s.defines("termination") or s.defines("initiation") for s in self.skills)
        ready = any(s.policy is not None for s in self.skills) or self.ready_selector is not None
        own = bool(self.reflexes) or self.guide is not None
        return not code and not ready and not own and self.spec.is_data

    @property
    def trains_from_data(self) -> bool:
        """Whether training, too, needs none of the user's Python code."""
        own = any(s.defines(m) for s in self.skills for m in s.methods)
        return self.is_data and self.spec.engine == "auto" and not own

    def skill(self, name: str) -> Skill:
        """The skill of this ``name``.

        Raises:
            SkillweaveError: there is none; the message lists them.
        """
        for skill in self.skills:
            if skill.name == name:
                return skill
        raise SkillweaveError(
            f"no skill {short(name)}; there are: {', '.join(s.name for s in self.skills)}"
        )

    def budget(self, skill: Skill) -> int:
        """Training steps of a ``skill``; 0 where its policy is ready."""
        return 0 if skill.policy is not None else skill.steps or self.skill_steps

    @property
    def choices(self) -> int:
        """Of how many a selector's choice is one: skills, times lengths if these are chosen."""
        lengths = self.call_steps.steps if isinstance(self.call_steps, Lengths) else (0,)
        return len(self.skills) * len(lengths)

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
            self.flat or self.algorithm,
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
            self.greedy_skills,
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
            self._check_algorithms(env.action_space)
            own = (s.algorithm for s in self.skills)
            for config in (self.algorithm, self.selector, self.flat, *own):
                if isinstance(config, AlgorithmConfig):
                    check_rollout(config, env.observation_space)
            for reflex in self.reflexes:
                reflex.check(env.action_space)
            self._fitted(env)
            self.fitted_selector(env.observation_space)
            fitted_guide(self, env.observation_space)
            return env.observation_space, env.action_space
        finally:
            env.close()

    def _check_algorithms(self, space: gym.Space[Any]) -> None:
        """Whether every algorithm can act where it is to act."""
        for skill in self.skills:
            if skill.policy is None:
                config = skill.algorithm or self.algorithm
                check_spaces(config, space, f"skill {skill.name!r}: ")
        if isinstance(self.selector, AlgorithmConfig):
            check_spaces(self.selector, gym.spaces.Discrete(self.choices), "selector: ")
        if self.flat is not None:
            check_spaces(self.flat, space, "flat: ")

    @property
    def ready_selector(self) -> ReadySelector | None:
        """The selector that is not trained; None: it is."""
        return ready_selector(self.selector, tuple(s.name for s in self.skills))

    def fitted_selector(self, observation_space: gym.Space[Any]) -> Policy | None:
        """The selector that is not trained, on this ``observation_space``; None: it is trained."""
        if (found := self.ready_selector) is None:
            return None
        choices = gym.spaces.Discrete(len(self.skills))
        return fitted(found, observation_space, choices, "selector", self.spec.name)

    def ready_policies(self) -> dict[str, Policy]:
        """By skill, the policies that are not trained, on the environment's spaces."""
        if all(s.policy is None for s in self.skills):
            return {}
        env = self.spec.make()
        try:
            return self._fitted(env)
        finally:
            env.close()

    def _fitted(self, env: gym.Env[Any, Any]) -> dict[str, Policy]:
        spaces = env.observation_space, env.action_space
        return {
            s.name: fitted(policy, *spaces, f"skill {s.name!r}", self.spec.name)
            for s in self.skills
            if (policy := ready_policy(s)) is not None
        }
