"""The table of a hierarchy: its levels and the roles in them, by path.

A skill whose ``policy`` is a hierarchy is trained inside: it is a level with its own skills and its
own selector. ``roles_of`` walks a declaration once; everything else reads the table. A changed
table, with choices as a run records them for example, is another table.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar, cast

from gymnasium import Space

from skillweave._internal.messages import short
from skillweave._internal.paths import (
    CRITIC,
    SELECTOR,
    is_below,
    join,
    level_of,
    levels_to,
    name_of,
)
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.experience.judges import Sharing
from skillweave.hierarchy.settings import Settings
from skillweave.runs.user_code import Texts, environment_texts, skill_texts
from skillweave.skills import ReadySelector, Skill, is_trained, ready_selector
from skillweave.skills.learnable import Learnable, NetworkFile
from skillweave.skills.lengths import Lengths
from skillweave.skills.own_part import OwnPart, declared_sees, file_of
from skillweave.skills.residual import Residual
from skillweave.skills.skill_set import LimitedCalls, SkillSet
from skillweave.training.role import Role

H = TypeVar("H", bound="Nestable")
CALL = 16
"""Approximate environment steps of a call without a declared length."""
_OF_SKILL = ("call_steps", "max_steps", "color")
"""Attributes of a skill that a hierarchy may be given."""


class Nestable:
    """The declaration of a hierarchy, as the table is made from it; it may be a skill of another.

    ``Declaration`` has the settings.
    """

    skills: Sequence[Skill]
    name: str

    def as_skill(self, name: str | None = None, **attributes: Any) -> Skill:
        """Return this hierarchy as a skill that is trained inside another hierarchy.

        ``skills=[Center(), inner]`` is short for ``skills=[Center(), inner.as_skill()]``.

        Args:
            name: of the skill; None: the hierarchy's.
            attributes: of the skill: ``call_steps=30``, ``max_steps=100``. A subclass of ``Skill``
                with ``policy = inner`` may have methods, too: a reward, an end.

        Raises:
            DeclarationError: a skill has no such attribute.
        """
        for field in attributes:
            if field not in _OF_SKILL:
                raise DeclarationError(
                    f"{self.name}.as_skill(): a skill that is a hierarchy takes no {short(field)}; "
                    f"it takes {', '.join(_OF_SKILL)}"
                )
        defaults = {"name": name or self.name, "policy": self}
        skill: Skill = type("Hierarchy", (Skill,), defaults | attributes)()
        return skill

    def _level(self, path: str, as_skill: Skill | None) -> Level:
        """Return the settings of this hierarchy, without those of hierarchies below."""
        raise NotImplementedError


@dataclass(kw_only=True)
class Level(LimitedCalls, Settings):
    """A hierarchy's own settings: of the outermost one, or of one that is a skill of another."""

    path: str
    """Empty for the outermost hierarchy."""
    as_skill: Skill | None
    """The hierarchy as a skill of the one above; None: it is the outermost."""
    spec: EnvSpec
    """The environment that it declares; equal at all levels."""
    skills: Mapping[str, Skill]
    """Its skills by path, in the order of a selector's choices."""
    flat: AlgorithmConfig | None
    """Settings of the flat baseline; None: those of ``algorithm``."""

    @property
    def selector_path(self) -> str:
        """The path of its selector."""
        return join(self.path, SELECTOR)

    @property
    def critic_path(self) -> str:
        """The path of its critic of skills."""
        return join(self.path, CRITIC)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its skills, without its path."""
        return tuple(map(name_of, self.skills))

    @property
    def goal_spaces(self) -> dict[str, Space[Any]]:
        """The spaces of goals of its skills that have some, by their names."""
        every = {name_of(path): skill.goal_space for path, skill in self.skills.items()}
        return {name: space for name, space in every.items() if space is not None}

    @cached_property
    def ready_selector(self) -> ReadySelector | None:
        """The ready selector; None: the selector is trained."""
        return ready_selector(self.selector, self.names)

    @cached_property
    def ready_guide(self) -> ReadySelector | None:
        """The guide of a selector that learns; None: no guide is declared."""
        return None if self.guide is None else ready_selector(self.guide.selector, self.names)

    @property
    def restricting_guide(self) -> ReadySelector | None:
        """The guide that restricts the selector; None: no guide does."""
        return self.ready_guide if self.guide is not None and self.guide.restrict else None

    @property
    def is_data(self) -> bool:
        """True if acting needs none of the user's Python code."""
        if self.reflexes or self.guide is not None or self.ready_selector is not None:
            return False
        skills = self.skills.values()
        seen = (declared_sees(s.sees, s.name) for s in skills if s.sees is not None)
        files = (file_of(skill) for skill in skills)
        learns_on = (file.mapping for file in files if file is not None)
        computes = any(mapping.functions() for mapping in (*seen, *learns_on))
        asks = any(s.defines("termination") or s.defines("initiation") for s in skills)
        return not (asks or computes)

    def skill_set(self, policies: Mapping[str, Policy]) -> SkillSet:
        """Return its skills that have a policy in ``policies``, by path, ready to be called."""
        skills = {path: skill for path, skill in self.skills.items() if path in policies}
        return SkillSet(
            tuple(skills.values()),
            tuple(policies[path] for path in skills),
            tuple(self.reflexes),
            self.call_steps,
            self.selection.greedy_skills is not False,
            self.selection.deliberation_cost,
            greedy_selector=self.selection.greedy_selector is not False,
            parts=self._parts(skills),
        )

    def _parts(self, paths: Iterable[str]) -> tuple[OwnPart | None, ...]:
        """Return the skills' own parts of observations and actions; (): none has one."""
        parts = tuple(self.role_of_skill(path, self.spec).part for path in paths)
        return parts if any(part is not None for part in parts) else ()

    def role_of_skill(self, path: str, spec: EnvSpec) -> Role:
        """Return the role of one of its skills, in the environment ``spec``."""
        skill = self.skills[path]
        config = self._config_of_skill(path)
        greedy = self.selection.greedy_skills is not False
        sharing = self._sharing if _shares(config) else None
        return Role(
            path, "skill", spec, config, skill, greedy=greedy, rest=self.rest, sharing=sharing
        )

    @cached_property
    def _sharing(self) -> Sharing:
        """Its skills that learn from each other's steps."""
        skills = (s for path, s in self.skills.items() if _shares(self._config_of_skill(path)))
        return Sharing(self.spec, tuple(skills))

    def _config_of_skill(self, path: str) -> AlgorithmConfig | None:
        """Return the algorithm that a skill learns by; None: it is ready, or a hierarchy."""
        skill = self.skills[path]
        config = None
        if is_trained(skill):
            config = skill.algorithm or self.algorithm
        if isinstance(skill.policy, Learnable):
            config = skill.policy.learning_on(config, f"skill {path!r}")
        return config

    def deciding_roles(self, spec: EnvSpec) -> tuple[Role, Role]:
        """Return the roles of its selector and of its critic, in the environment ``spec``."""
        own = None if self.as_skill is None else self.as_skill.goal_space
        selector = Role(
            self.selector_path,
            "selector",
            spec,
            self.selector if isinstance(self.selector, AlgorithmConfig) else None,
            choices=self.choices,
            chosen_goals=self.goal_spaces,
            own_goals=own,
            skills=self.names,
            row_steps=self._usual_steps,
            greedy=self.selection.greedy_selector is not False,
            guide_kl=None if self.guide is None else self.guide.target_kl,
        )
        margin = self.together.margin if self.together.interrupt else None
        critic = Role(
            self.critic_path,
            "critic",
            spec,
            choices=len(self.skills),
            observed_goals=self.goal_spaces,
            own_goals=own,
            margin=margin,
        )
        return selector, critic

    @property
    def _usual_steps(self) -> int:
        """Approximate environment steps of a call."""
        if isinstance(self.call_steps, Lengths):
            return round(sum(self.lengths) / len(self.lengths))
        return self.call_steps or CALL


def _shares(config: AlgorithmConfig | None) -> bool:
    """Return whether a skill with this algorithm learns from other skills' steps."""
    return bool(getattr(config, "shared_replay", 0.0))


@dataclass(frozen=True)
class Roles:
    """The levels of a hierarchy and all roles in them, by path."""

    levels: Mapping[str, Level]
    """By path: the outermost first, each before those below it."""

    def __getitem__(self, path: str) -> Role:
        return self.by_path[path]

    @cached_property
    def by_path(self) -> dict[str, Role]:
        """All roles: skills, each before those inside it; after them their selector and critic."""
        return {role.path: role for role in self._in_level("")}

    def _in_level(self, path: str) -> Iterator[Role]:
        """Yield the roles of a level and of those below it."""
        level = self.levels[path]
        for path in level.skills:
            yield level.role_of_skill(path, self.spec)
            if path in self.levels:
                yield from self._in_level(path)
        yield from level.deciding_roles(self.spec)

    @property
    def outermost(self) -> Level:
        """The outermost level."""
        return self.levels[""]

    @property
    def spec(self) -> EnvSpec:
        """The environment of all."""
        return self.outermost.spec

    @cached_property
    def skills(self) -> dict[str, Skill]:
        """All skills by path; the skills of a hierarchy follow it."""
        return {role.path: role.skill for role in self.by_path.values() if role.skill is not None}

    @property
    def code(self) -> Texts:
        """The texts of the environment and of the skills, to be compared later."""
        reflexes = [reflex for level in self.levels.values() for reflex in level.reflexes]
        return environment_texts(self.spec) | skill_texts(self.skills, reflexes)

    def below(self, level: str) -> list[Role]:
        """Return the roles in a level, and in levels below it."""
        return [role for path, role in self.by_path.items() if is_below(path, level)]

    def levels_from(self, level: str) -> list[Level]:
        """Return a level and all levels below it, each before those below it."""
        return [x for path, x in self.levels.items() if path == level or is_below(path, level)]

    def levels_to(self, path: str) -> list[Level]:
        """Return the levels that a part is in, from the outermost; a level is in itself."""
        return [self.levels[x] for x in levels_to(path) if x in self.levels]

    def skills_to(self, path: str, level: str) -> list[Skill]:
        """Return the skills on the way from a level to a part below it, the outermost first."""
        return [self.skills[x] for x in levels_to(path) if is_below(x, level) and x in self.skills]

    def a_skill_learns(self, level: Level) -> bool:
        """Return True if a skill of a level learns, or a part of a skill that is a hierarchy."""
        roles = self.below(level.path)
        return any(r.config is not None and r.path != level.selector_path for r in roles)

    def learns_apart(self, level: Level) -> bool:
        """Return True if a stage trains a skill or the selector of a level apart."""
        return level.learn != "together" or not self.a_skill_learns(level)

    def learns_together(self, level: Level) -> bool:
        """Return True if a stage trains all of a level together."""
        return level.learn != "apart" and self.a_skill_learns(level)

    @property
    def trained(self) -> list[Level]:
        """The levels with stages of their own, in the order of training."""
        order = [self.levels[r.level] for r in self.by_path.values() if r.kind == "selector"]
        return [x for x in order if all(map(self.learns_apart, self.levels_to(x.path)[:-1]))]

    @property
    def is_data(self) -> bool:
        """True if acting needs none of the user's Python code, so a saved run is complete."""
        leaves = [skill for path, skill in self.skills.items() if path not in self.levels]
        ready = any(not is_trained(s) or isinstance(s.policy, Residual) for s in leaves)
        return not ready and all(x.is_data for x in self.levels.values()) and self.spec.is_data

    @property
    def trains_from_data(self) -> bool:
        """True if training, too, needs none of the user's Python code."""
        code = any(skill.defines(m) for skill in self.skills.values() for m in skill.methods)
        return self.is_data and self.spec.engine == "auto" and not code

    def with_bases(self, restored: Callable[[str, Policy], Policy]) -> Roles:
        """Return the table with other ready policies in place of those that skills correct.

        Args:
            restored: the path of a skill and its policy to the other policy.
        """

        def change(level: Level) -> Level:
            """Return a level with restored ready policies in its residual skills."""
            skills = dict(level.skills)
            for path, skill in level.skills.items():
                part = self[path].part if isinstance(skill.policy, Residual) else None
                if part is not None and part.base is not None:
                    skills[path] = copy.copy(skill)
                    base = restored(path, part.base)
                    skills[path].policy = replace(skill.policy, policy=base)
            return replace(level, skills=skills)

        return self.changed(change)

    def bases(self) -> dict[str, Policy]:
        """Return the ready policies that skills correct, by the paths of these."""
        parts = {path: self[path].part for path in self.skills if path not in self.levels}
        return {
            path: part.base
            for path, part in parts.items()
            if part is not None and part.base is not None
        }

    def files(self) -> dict[str, NetworkFile]:
        """Return the files from which skills learn on, by the paths of these."""
        files = {path: file_of(skill) for path, skill in self.skills.items()}
        return {path: file for path, file in files.items() if file is not None}

    def changed(self, change: Callable[[Level], Level]) -> Roles:
        """Return the table with each level replaced by ``change`` of it."""
        return Roles({path: change(level) for path, level in self.levels.items()})


def hierarchies_of(declared: H) -> dict[str, H]:
    """Return a declared hierarchy and all below it, by path, each before those below it.

    Raises:
        DeclarationError: a hierarchy contains itself.
    """
    found: dict[str, H] = {}

    def add(hierarchy: H, path: str, above: tuple[H, ...]) -> None:
        """Add a hierarchy and those below it; one may not contain itself."""
        if any(hierarchy is other for other in above):
            raise DeclarationError(
                f"{path} is a hierarchy that contains itself: it is among its own skills"
            )
        found[path] = hierarchy
        for skill in hierarchy.skills:
            if isinstance(skill.policy, Nestable):
                add(cast(H, skill.policy), join(path, skill.name), (*above, hierarchy))

    add(declared, "", ())
    return found


def roles_of(declared: Nestable) -> Roles:
    """Return the table of a declared hierarchy with the settings that it has now.

    The skills are the declared ones, so what is set on them later holds for the table, too.

    Raises:
        DeclarationError: a hierarchy contains itself.
    """
    levels: dict[str, Level] = {}
    for path, hierarchy in hierarchies_of(declared).items():
        as_skill = levels[level_of(path)].skills[path] if path else None
        levels[path] = hierarchy._level(path, as_skill)
    return Roles(levels)
