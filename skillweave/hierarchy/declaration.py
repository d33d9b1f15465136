"""The declaration of a hierarchy: data and checks, no training."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from skillweave._internal.messages import short, suggest
from skillweave._internal.paths import AGENT, CRITIC, SELECTOR, join
from skillweave.algorithms.config import AlgorithmConfig, AlgorithmSettings, alone
from skillweave.calls.neighbors import check_features
from skillweave.calls.predicates import named_predicates
from skillweave.envs.make import Spaces
from skillweave.errors import DeclarationError
from skillweave.hierarchy.checks import (
    check_level,
    check_nested,
    checked_skills,
)
from skillweave.hierarchy.fitting import check_settings, ready_policies, ready_selectors
from skillweave.hierarchy.roles import Level, Nestable, Roles, hierarchies_of, roles_of
from skillweave.hierarchy.schedule import DEFAULT_STEPS, budgets_of, splits_total, stages_of
from skillweave.hierarchy.settings import (
    Apart,
    CallSteps,
    Guide,
    Learn,
    Selection,
    SelectorValue,
    settings_in,
)
from skillweave.networks.config import seeing_all
from skillweave.schema import Positive, check_fields, fitted
from skillweave.skills import Reflex, Skill, is_trained
from skillweave.spaces import action_codec, obs_codec
from skillweave.training.env_check import check_env
from skillweave.training.plain_agent import Declared, PlainAgent
from skillweave.training.stage import TOGETHER, Stage, Together

D = TypeVar("D", bound="Declaration")
RESERVED = (SELECTOR, CRITIC, TOGETHER, AGENT)
"""Names of stages that are not skills."""


class Declaration(Nestable, Declared):
    """The declaration of a hierarchy: checks, stages and budgets.

    ``Hierarchy`` describes its settings, and has their defaults.
    """

    call_steps: CallSteps
    steps: int | None
    learn: Learn
    algorithm: AlgorithmConfig
    selector: SelectorValue
    reflexes: Sequence[Reflex]
    rest: Any
    apart: Apart
    together: Together
    selection: Selection
    guide: Guide | None
    predicates: Mapping[str, Any]
    features: Any
    _caller = "hierarchy"

    def validate(self) -> None:
        """Check every setting; training and loading call it again, as attributes may be set.

        Raises:
            DeclarationError: a setting is wrong; the message names it.
        """
        check_env(self.env)
        self.skills = checked_skills(self.skills, RESERVED)
        check_fields(self)
        self.reflexes = tuple(self.reflexes)
        names = {skill.name for skill in self.skills}
        if same := sorted(names & named_predicates(self.predicates, "predicates").keys()):
            raise DeclarationError(
                f"predicates: {same[0]!r} is the name of a skill, too, so a mission could mean "
                "either, the skill's success or the predicate: give the predicate another name"
            )
        check_features(self.features, "Hierarchy")
        check_level(self._level("", None))
        hierarchies_of(self)  # raises where one contains itself
        for skill in self.skills:
            if isinstance(skill.policy, Declaration):
                skill.policy.validate()
        check_nested(roles_of(self))  # last: messages then call every skill by its path
        if self.steps not in (None, self.total_steps) and not self._splits_steps():
            raise DeclarationError(
                f"steps is {self.steps:,}, but all its parts have steps of their own, "
                f"{self.total_steps:,} in all: leave out steps, or those of skills, "
                "Apart(skill_steps, selector_steps) and Together(steps)"
            )

    def _splits_steps(self) -> bool:
        """Return True if ``steps`` changes the budget of a stage, or no stage is trained."""
        return splits_total(roles_of(self))

    def _level(self, path: str, as_skill: Skill | None) -> Level:
        """Return the settings of this hierarchy, without those of hierarchies below."""
        return Level(
            path=path,
            as_skill=as_skill,
            spec=self.spec,
            skills={join(path, skill.name): skill for skill in self.skills},
            **settings_in(self),
            flat=self.train_defaults.flat,
        )

    def skill(self, name: str) -> Skill:
        """Return the skill of this ``name``, or path.

        Raises:
            DeclarationError: no skill has that name; the message lists the names.
        """
        skills = roles_of(self).skills
        if not isinstance(name, str) or name not in skills:
            raise DeclarationError(f"no skill {short(name)}{suggest(name, skills)}")
        return skills[name]

    def stages(self) -> list[Stage]:
        """Return all stages of training, in their order."""
        return stages_of(roles_of(self))

    def budgets(self) -> dict[str, int]:
        """Return the training steps of each stage, by its path."""
        return budgets_of(roles_of(self))

    @property
    def total_steps(self) -> int:
        """All training steps of skills and selector: the flat baseline's budget."""
        return sum(self.budgets().values())

    def scale(self, factor: float) -> None:
        """Multiply every training budget by ``factor``, in place.

        Raises:
            DeclarationError: the factor is not positive and finite.
        """
        fitted(Positive, factor, "scale")
        for path, hierarchy in hierarchies_of(self).items():
            for skill in hierarchy.skills:
                if is_trained(skill):
                    skill.steps = _scaled(skill.steps, factor)
            # A hierarchy below without its own total shares the outer one.
            steps = hierarchy.steps
            if not path and steps is None and self._splits_steps():
                steps = DEFAULT_STEPS
            hierarchy.steps = _scaled(steps, factor)
            hierarchy.apart = replace(
                hierarchy.apart,
                skill_steps=_scaled(hierarchy.apart.skill_steps, factor),
                selector_steps=_scaled(hierarchy.apart.selector_steps, factor),
            )
            hierarchy.together = replace(
                hierarchy.together, steps=_scaled(hierarchy.together.steps, factor)
            )

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
        config = algorithm or self.train_defaults.flat or alone(seeing_all(self.algorithm))
        return PlainAgent(self.env, config, steps, train_defaults=self.train_defaults)

    def check_spaces(self) -> Spaces:
        """Make the declared environment once, and return its spaces.

        Raises:
            DeclarationError: a space, a setting or a policy does not fit.
        """
        spaces = self.spec.read_spaces()
        obs_codec(spaces.observation)
        action_codec(spaces.action)
        roles = roles_of(self)
        check_settings(roles)
        ready_policies(roles)
        ready_selectors(roles)
        return spaces


def _scaled(steps: int | None, factor: float) -> int | None:
    return None if steps is None else max(1, round(steps * factor))


def with_roles(declared: D, roles: Roles) -> D:
    """Return a copy of a hierarchy and of those below it, with the settings of a table of it.

    The skills are copies, too.
    """
    copies: dict[str, D] = {}
    for path, hierarchy in reversed(hierarchies_of(declared).items()):
        level = roles.levels[path]
        skills = {skill_path: copy.copy(skill) for skill_path, skill in level.skills.items()}
        for skill_path, skill in skills.items():
            if skill_path in copies:
                skill.policy = copies[skill_path]
        copies[path] = whole = copy.copy(hierarchy)
        whole.skills = tuple(skills.values())
        vars(whole).update(settings_in(level))
    return copies[""]
