"""The declaration of a hierarchy: data and checks, no training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import gymnasium as gym

from skillweave.algorithms.config import PPO, AlgorithmConfig, AlgorithmSettings
from skillweave.arguments import checked_names
from skillweave.collecting.lengths import Lengths
from skillweave.collecting.skill_set import SkillSet
from skillweave.envs.make import EnvSpec, Spaces, spec_of
from skillweave.errors import DeclarationError
from skillweave.hierarchy.budgets import budgets_of, scale_budgets
from skillweave.hierarchy.checks import check_calls, checked_reflexes, checked_skills
from skillweave.hierarchy.fitting import check_settings, fitted_policies, fitted_selectors
from skillweave.hierarchy.guidance import check_selection
from skillweave.hierarchy.nesting import (
    Nestable,
    check_ends,
    check_nested,
    every_skill,
    inner_hierarchies,
    inner_of,
)
from skillweave.hierarchy.settings import Apart, Guide, Selection
from skillweave.messages import short
from skillweave.networks.config import seeing_all
from skillweave.selectors import ReadySelector, ready_selector
from skillweave.selectors.ready import ReadyValue
from skillweave.settings import AtLeastOne, Check, check_fields, fitted
from skillweave.skills import Reflex, Skill
from skillweave.spaces import action_codec, obs_codec
from skillweave.training.checks import EnvValue, check_env
from skillweave.training.defaults import TrainDefaults
from skillweave.training.plain_agent import AGENT, PlainAgent
from skillweave.training.stage import CRITIC, SELECTOR, TOGETHER, Together
from skillweave.types import Policy

RESERVED = (SELECTOR, CRITIC, TOGETHER, AGENT)
"""Names of stages that are not skills."""
CallSteps = Annotated[
    AtLeastOne | Lengths | None,
    Check("a whole number of at least 1, Lengths(1, ..., 128), or None"),
]
"""Limits of a call's length."""
SelectorValue = Annotated[
    AlgorithmConfig | ReadyValue,
    Check(
        "the settings of an algorithm, such as PPO(), or a ready selector: a function of "
        "observations, an Automaton or a tree",
        lambda x: not isinstance(x, type),
    ),
]
"""A selector that is trained, or a ready one."""


@checked_names
@dataclass
class Declaration(Nestable):
    """Skills, reflexes and a selector on one environment, with budgets in environment steps.

    Raises:
        DeclarationError: the declaration is wrong; the message names the skill and the field.
    """

    env: EnvValue
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec`` for more."""
    skills: Sequence[Skill]
    """The skills that the selector chooses from; a hierarchy among them is trained inside."""
    call_steps: CallSteps = 40
    """Steps of a skill before the selector decides again; None: until the skill ends by itself."""
    steps: AtLeastOne | None = None
    """Training steps in all, split by ``learn``; None: 1,000,000. A budget that a skill, ``apart``
    or ``together`` sets replaces that part and leaves the others as they are."""
    learn: Literal["together", "apart", "apart, then together"] = "together"
    """Train skills and selector from the same steps ("together"); or skills one by one, then the
    selector ("apart"); or one after the other, half of the steps each. Where no skill learns, the
    selector trains alone."""
    algorithm: AlgorithmSettings = field(default_factory=PPO)
    """The algorithm of every skill that sets no other."""
    selector: SelectorValue = field(default_factory=PPO)
    """The algorithm of the selector; its γ and n_steps count environment steps. Or a ready
    selector, not trained: a function of observations, an ``Automaton``, or a ``tree.Sequence``."""
    reflexes: Sequence[Reflex] = ()
    """Rules that override the running skill's action, also while skills train."""
    apart: Apart = field(default_factory=Apart)
    """Settings of learning apart: budgets, and the start of skills."""
    together: Together = field(default_factory=Together)
    """Settings of learning together: budget, the task's weight, interruption, exploration."""
    selection: Selection = field(default_factory=Selection)
    """Settings of the selector's choices: cost of a call, greedy or sampling."""
    guide: Guide | None = None
    """A ready selector that guides one that learns."""
    train_defaults: TrainDefaults = field(default_factory=TrainDefaults)
    """Values for arguments of ``train`` that its caller leaves out."""
    name: str = "hierarchy"
    """Its name where it is a skill of another hierarchy."""
    recorded = False
    """True for a run that was loaded without its code; some of what was declared is missing."""

    def __post_init__(self) -> None:
        self.validate()

    def validate(self) -> None:
        """Check every setting; training and loading call it again, as attributes may be set.

        Raises:
            DeclarationError: a setting is wrong; the message names it.
        """
        check_env(self.env)
        self.skills = checked_skills(self.skills, RESERVED)
        self.reflexes = checked_reflexes(self.reflexes)
        check_fields(self)
        check_selection(self)
        check_calls(self.call_steps, self.skills)
        check_ends(self)
        for _, inner in inner_hierarchies(self.skills):
            inner.validate()
        check_nested(self)  # last: messages then call every skill by its path

    @property
    def spec(self) -> EnvSpec:
        """The environment, fully specified."""
        return spec_of(self)

    @property
    def is_data(self) -> bool:
        """True if acting needs none of the user's Python code, so a saved run is complete."""
        code = any(s.defines("termination") or s.defines("initiation") for s in self.skills)
        plain = (inner.is_data if (inner := inner_of(s)) else s.policy is None for s in self.skills)
        ready = self.ready_selector is not None or not all(plain)
        functions = bool(self.reflexes) or self.guide is not None
        return not code and not ready and not functions and self.spec.is_data

    @property
    def trains_from_data(self) -> bool:
        """True if training, too, needs none of the user's Python code."""
        code = any(s.defines(m) for _, s in every_skill(self.skills) for m in s.methods)
        return self.is_data and self.spec.engine == "auto" and not code

    def skill(self, name: str) -> Skill:
        """Return the skill of this ``name``, or path.

        Raises:
            DeclarationError: no skill has that name; the message lists the names.
        """
        skills = dict(every_skill(self.skills))
        if not isinstance(name, str) or name not in skills:
            raise DeclarationError(f"no skill {short(name)}; there are: {', '.join(skills)}")
        return skills[name]

    def budgets(self) -> dict[str, int]:
        """Return the training steps of each stage, by its path."""
        return budgets_of(self)

    @property
    def choices(self) -> int:
        """Number of a selector's choices: skills, times lengths if these are chosen, too."""
        lengths = self.call_steps.steps if isinstance(self.call_steps, Lengths) else (0,)
        return len(self.skills) * len(lengths)

    def chooses_from(self, path: str, actions: gym.Space[Any]) -> gym.Space[Any]:
        """Return the action space of a selector, critic or skill at ``path``.

        Args:
            actions: the environment's action space, on which skills act.
        """
        node, _, name = path.rpartition("/")
        if name not in (SELECTOR, CRITIC):
            return actions
        inner = inner_of(self.skill(node)) if node else self
        assert inner is not None
        return gym.spaces.Discrete(inner.choices if name == SELECTOR else len(inner.skills))

    @property
    def total_steps(self) -> int:
        """All training steps of skills and selector: the flat baseline's budget."""
        return sum(self.budgets().values())

    @property
    def any_skill_learns(self) -> bool:
        """True if a skill learns, or a part of a skill that is a hierarchy."""
        hierarchies = (inner_of(s) for s in self.skills)
        return any(s.policy is None for s in self.skills) or any(
            h is not None and (h.ready_selector is None or h.any_skill_learns) for h in hierarchies
        )

    @property
    def learns_apart(self) -> bool:
        """True if a stage trains a skill or the selector apart."""
        return self.learn != "together" or not self.any_skill_learns

    @property
    def learns_together(self) -> bool:
        """True if a stage trains all together."""
        return self.learn != "apart" and self.any_skill_learns

    def scale(self, factor: float) -> None:
        """Multiply every training budget by ``factor``, in place.

        Raises:
            DeclarationError: the factor is not positive and finite.
        """
        if not 0.0 < factor < float("inf"):
            raise DeclarationError(f"scale is {factor}; it must be positive and finite")
        scale_budgets(self, factor)

    def plain_agent(self, algorithm: AlgorithmConfig | None = None) -> PlainAgent:
        """Return the flat baseline: one agent on the task itself, without skills and reflexes.

        Args:
            algorithm: its settings; None: those of ``train_defaults``, or of the skills.
        """
        algorithm = fitted(AlgorithmSettings | None, algorithm, "flat")
        steps = self.total_steps or self.steps
        if not steps:
            raise DeclarationError(
                "no part of this hierarchy is trained, so the flat baseline has no budget: set "
                "steps"
            )
        config = algorithm or self.train_defaults.flat or seeing_all(self.algorithm)
        return PlainAgent(self.env, config, steps, train_defaults=self.train_defaults)

    def skill_set(
        self, policies: Sequence[Policy], skills: Sequence[Skill] | None = None
    ) -> SkillSet:
        """Return the ``skills`` (None: all) with their ``policies``, ready to be called."""
        return SkillSet(
            tuple(self.skills if skills is None else skills),
            tuple(policies),
            tuple(self.reflexes),
            self.call_steps,
            self.selection.greedy_skills is not False,
            self.selection.call_cost,
            greedy_selector=self.selection.greedy_selector is not False,
        )

    def check_spaces(self) -> Spaces:
        """Make the environment once, and return its spaces.

        Raises:
            DeclarationError: a space, a setting or a policy does not fit.
        """
        spaces = self.spec.read_spaces()
        obs_codec(spaces.observation)
        action_codec(spaces.action)
        check_settings(self, spaces)
        fitted_policies(self, spaces)
        fitted_selectors(self, spaces.observation)
        return spaces

    @property
    def ready_selector(self) -> ReadySelector | None:
        """The ready selector; None: the selector is trained."""
        return ready_selector(self.selector, tuple(s.name for s in self.skills))

    def ready_selectors(self) -> dict[str, Policy]:
        """Return the ready selectors, by path, on the environment's observations."""
        hierarchies = (self, *(inner_of(s) for _, s in every_skill(self.skills)))
        if all(h is None or h.ready_selector is None for h in hierarchies):
            return {}
        return fitted_selectors(self, self.spec.spaces.observation)

    def ready_policies(self) -> dict[str, Policy]:
        """Return the ready policies of skills, by path, on the environment's spaces."""
        if all(s.policy is None for s in self.skills):
            return {}
        return fitted_policies(self, self.spec.spaces)
