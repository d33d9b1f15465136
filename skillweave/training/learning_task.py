"""Environments of a stage, with the spaces and collectors of its learners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gymnasium as gym

from skillweave.collecting.acting import Acting
from skillweave.collecting.collector import Collector
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.hierarchy_collector import HierarchyCollector
from skillweave.collecting.levels import CRITIC, SELECTOR
from skillweave.collecting.skill_collector import SkillCollector
from skillweave.collecting.skill_set import SkillSet
from skillweave.envs.engine import Engine
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.skills import Reflex, Skill

CALL = 16
"""Approximate environment steps of a call without a declared length."""


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

    def learners_collector(
        self, num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        """Return a collector whose episodes are reported; see ``MakeCollector``."""
        collector = self.collector(num_envs, acting, first, shared)
        collector.log_info = self.log_info
        return collector


def skill_task(
    spec: EnvSpec,
    skill: Skill | None = None,
    reflexes: Sequence[Reflex] = (),
    starters: SkillSet | None = None,
    start_calls: int = 0,
    search_steps: int | None = None,
    episode_calls: int = 1,
) -> LearningTask:
    """Return the learning task of a skill's stage; ``skill`` None: of the task itself.

    Args:
        starters: skills that can act already; they bring the environment to where the skill may
            start.
        start_calls: an episode starts after up to this many calls of ``starters``.
        search_steps: reset an episode in which the skill cannot start within this many steps.
        episode_calls: the most calls of the skill in an episode.
    """
    search = start_calls, search_steps, episode_calls

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return SkillCollector(engine, acting, skill, tuple(reflexes), starters, *search)

    return LearningTask(spec.name, *spec.spaces, collector)


def selector_task(
    spec: EnvSpec, skills: SkillSet, guide: ActiveGuide | None = None, as_skill: Skill | None = None
) -> LearningTask:
    """Return the learning task of a selector that calls ready skills.

    Args:
        guide: a ready selector that guides its decisions.
        as_skill: the hierarchy as a skill of another one; None: the outermost hierarchy.
    """

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return HierarchyCollector(engine, acting, skills, shared, guide, as_skill)

    observation_space = spec.spaces.observation
    choices = gym.spaces.Discrete(skills.choices)
    return LearningTask(
        spec.name, observation_space, choices, collector, skills.usual_steps or CALL
    )


@dataclass(frozen=True)
class JointTask(LearningTask):
    """Environments in which a selector calls skills, of which some learn, too."""

    skills: SkillSet = field(kw_only=True)
    """The skills; learning ones have any policy, or are ``UntrainedHierarchy``."""
    skill_space: gym.Space[Any] = field(kw_only=True)
    """Action space of the skills."""
    spec: EnvSpec = field(kw_only=True)
    guide: ActiveGuide | None = field(kw_only=True)
    """A ready selector that guides the selector's decisions, or decides in its place."""
    as_skill: Skill | None = field(kw_only=True)
    """The hierarchy as a skill of another one."""
    margins: Mapping[str, float] = field(kw_only=True)
    """Margins of interruption in hierarchies below, by the paths of their critics."""
    guide_kl: Mapping[str, float] = field(kw_only=True)
    """Target KL of guides in hierarchies below, by the paths of their selectors."""

    def chooses_from(self, path: str) -> gym.Space[Any]:
        """Return the action space of a skill, selector or critic at ``path``."""
        *nodes, name = path.split("/")
        level = self.level(nodes)
        if name == SELECTOR:
            return gym.spaces.Discrete(level.choices)
        return gym.spaces.Discrete(len(level.skills)) if name == CRITIC else self.skill_space

    def steps_of_row(self, path: str) -> int:
        """Return the approximate environment steps of a row of the learner at ``path``."""
        *nodes, name = path.split("/")
        return self.level(nodes).usual_steps or CALL if name == SELECTOR else 1

    def is_greedy(self, path: str) -> bool:
        """Return True if the learner at ``path`` acts greedily in evaluations."""
        *nodes, name = path.split("/")
        level = self.level(nodes)
        return level.greedy_selector if name == SELECTOR else level.greedy

    def level(self, nodes: Sequence[str]) -> SkillSet:
        """Return the skills of a hierarchy below, by the names on the way to it."""
        skills = self.skills
        for node in nodes:
            number = [s.name for s in skills.skills].index(node)
            inner: Any = skills.policies[number]
            skills = inner.skills
        return skills

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
    spec: EnvSpec,
    skills: SkillSet,
    guide: ActiveGuide | None = None,
    as_skill: Skill | None = None,
    margins: Mapping[str, float] | None = None,
    guide_kl: Mapping[str, float] | None = None,
) -> JointTask:
    """Return the learning task of a selector that calls skills, of which some learn, too."""
    plain = skill_task(spec)
    return JointTask(
        spec.name,
        plain.observation_space,
        gym.spaces.Discrete(skills.choices),
        plain.collector,
        skills.usual_steps or CALL,
        skills=skills,
        skill_space=plain.action_space,
        spec=spec,
        guide=guide,
        as_skill=as_skill,
        margins=margins or {},
        guide_kl=guide_kl or {},
    )
