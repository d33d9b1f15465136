"""Environments of a stage, with the spaces and collectors of its learners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import gymnasium as gym

from skillweave.collecting.acting import Acting
from skillweave.collecting.collector import Collector
from skillweave.collecting.hierarchy_collector import HierarchyCollector
from skillweave.collecting.skill_collector import NAMED_SHARE, SkillCollector
from skillweave.collecting.skill_set import SkillSet
from skillweave.envs.engine import Engine, GymnasiumEngine
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.skills import Reflex, Skill
from skillweave.training.role import Role, agent_role

C = TypeVar("C", bound=Collector)


class MakeCollector(Protocol):
    """A function that makes a collector of a learning task."""

    def __call__(
        self, num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        """Return a collector of ``num_envs`` environments.

        Args:
            acting: the acting policies; None if this object is only a template for ``like()``.
            first: the number of the first environment, for messages.
            shared: members learn from the experience of all, each with its own γ.
        """
        ...


@dataclass(frozen=True)
class Called:
    """Skills that a selector calls, and the environment in which it does."""

    spec: EnvSpec
    skills: SkillSet


@dataclass(frozen=True)
class LearningTask:
    """Environments, with the learner's spaces and collectors."""

    name: str
    """Name of the environment in messages."""
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    """The learner's action space: a selector chooses among skills."""
    collector: MakeCollector
    row_steps: int = 1
    """Approximate environment steps of a row of experience."""
    log_info: tuple[str, ...] = ()
    """Keys of ``info`` that collectors of learners log."""
    called: Called | None = None
    """What is called in the outermost hierarchy; None: it is another learner's task."""
    log_calls: tuple[str, ...] | None = None
    """Keys of ``info`` in the log of their calls; None: none is kept."""

    def learners_collector(
        self, num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        """Return a collector whose episodes are reported; see ``MakeCollector``."""
        collector = self.collector(num_envs, acting, first, shared)
        return self.logged(collector)

    def logged(self, collector: C) -> C:
        """Return a collector that logs what is to be logged."""
        if isinstance(collector.engine, GymnasiumEngine):
            collector.engine.trains = True
        collector.log_info, collector.log_calls = self.log_info, self.log_calls
        return collector


def skill_task(
    role: Role,
    reflexes: Sequence[Reflex] = (),
    starters: SkillSet | None = None,
    start_calls: int = 0,
    search_steps: int | None = None,
    episode_calls: int = 1,
    start_after: tuple[str, ...] = (),
    call_limit: int | None = None,
    named_share: float = NAMED_SHARE,
) -> LearningTask:
    """Return the learning task of a skill's stage, or of a plain agent's.

    Args:
        starters: skills that can act already; they bring the environment to where the skill may
            start.
        start_calls: an episode starts after up to this many calls of ``starters``.
        search_steps: reset an episode in which the skill cannot start within this many steps.
        episode_calls: the most calls of the skill in an episode.
        start_after: names among ``starters``; a share of the episodes start after a call of one.
        call_limit: the most steps of a call; None: the skill's own limit.
        named_share: that share.
    """
    search = start_calls, search_steps, episode_calls, start_after, call_limit, named_share
    spec, skill = role.spec, role.skill

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return SkillCollector(
            engine, acting, skill, tuple(reflexes), starters, *search, part=role.part
        )

    return LearningTask(spec.name, role.observation_space, role.action_space, collector)


def selector_task(
    role: Role, skills: SkillSet, guide: ActiveGuide | None = None, as_skill: Skill | None = None
) -> LearningTask:
    """Return the learning task of a selector that calls ready skills.

    Args:
        guide: a ready selector that guides its decisions.
        as_skill: the hierarchy as a skill of another one; None: the outermost hierarchy.
    """
    spec = role.spec

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return HierarchyCollector(engine, acting, skills, shared, guide, as_skill)

    return LearningTask(
        spec.name,
        role.observation_space,
        role.action_space,
        collector,
        role.row_steps,
        called=Called(spec, skills) if as_skill is None else None,
    )


@dataclass(frozen=True)
class JointTask(LearningTask):
    """Environments in which a selector calls skills, of which some learn, too."""

    selector: str = field(kw_only=True)
    """The path of the selector."""
    roles: Mapping[str, Role] = field(kw_only=True)
    """The roles of the selector's level, and of levels below it, by path."""
    skills: SkillSet = field(kw_only=True)
    """The skills; learning ones have any policy, or are ``UntrainedHierarchy``."""
    guide: ActiveGuide | None = field(kw_only=True)
    """A ready selector that guides the selector's decisions, or decides in its place."""
    as_skill: Skill | None = field(kw_only=True)
    """The hierarchy as a skill of another one."""

    @property
    def spec(self) -> EnvSpec:
        """The environment."""
        return self.roles[self.selector].spec

    def joint_collector(
        self,
        engine: Engine,
        acting: Acting | None,
        learners: Mapping[str, Acting],
        margins: Mapping[str, float],
    ) -> HierarchyCollector:
        """Return a collector of environments in ``engine``.

        Args:
            acting: the selector; None: the guide decides.
            learners, margins: see ``HierarchyCollector``.
        """
        return HierarchyCollector(
            engine,
            acting,
            self.skills,
            guide=self.guide,
            as_skill=self.as_skill,
            learners=learners,
            margins=margins,
        )


def joint_task(
    selector: str,
    roles: Mapping[str, Role],
    skills: SkillSet,
    guide: ActiveGuide | None = None,
    as_skill: Skill | None = None,
) -> JointTask:
    """Return the learning task of a selector that calls skills, of which some learn, too.

    Args:
        selector: its path.
        roles: of its level, and of levels below it, by path.
        skills, guide, as_skill: see ``JointTask``.
    """
    role = roles[selector]
    return JointTask(
        role.spec.name,
        role.observation_space,
        role.action_space,
        skill_task(agent_role(role.spec)).collector,
        role.row_steps,
        called=Called(role.spec, skills) if as_skill is None else None,
        selector=selector,
        roles=roles,
        skills=skills,
        guide=guide,
        as_skill=as_skill,
    )
