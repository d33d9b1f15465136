"""Environments of a stage, with the spaces and collectors of its learners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import gymnasium as gym

from skillweave.envs.engine import GymnasiumEngine
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.acting import Acting
from skillweave.experience.collector import Collector
from skillweave.experience.learners import Alone, Calling
from skillweave.experience.search import Starts
from skillweave.skills import Reflex
from skillweave.skills.skill_set import SkillSet
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
    starts: Starts | None = None,
    limit: int | None = None,
) -> LearningTask:
    """Return the learning task of a skill's stage, or of a plain agent's.

    Args:
        role: who learns.
        reflexes: in force while it acts.
        starts: how calls of the skill start; None: wherever it may.
        limit: the most steps of a call; None: the skill's own limit.
    """
    spec, skill = role.spec, role.skill
    who = Alone(skill, tuple(reflexes), role.part, starts or Starts(), limit)

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        return Collector(make_engine(spec, num_envs, first=first), acting, who)

    return LearningTask(spec.name, role.observation_space, role.action_space, collector)


def selector_task(role: Role, who: Calling) -> LearningTask:
    """Return the learning task of a selector that calls ready skills."""
    spec = role.spec

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return Collector(engine, acting, replace(who, keep_rewards=shared))

    return LearningTask(
        spec.name,
        role.observation_space,
        role.action_space,
        collector,
        role.row_steps,
        called=_called(spec, who),
    )


def _called(spec: EnvSpec, who: Calling) -> Called | None:
    return Called(spec, who.skills) if who.skill is None else None


@dataclass(frozen=True)
class JointTask(LearningTask):
    """Environments in which a selector calls skills, of which some learn, too."""

    selector: str = field(kw_only=True)
    """The path of the selector."""
    roles: Mapping[str, Role] = field(kw_only=True)
    """The roles of the selector's level, and of levels below it, by path."""
    who: Calling = field(kw_only=True)
    """Who acts; its guide may decide in the selector's place."""

    @property
    def spec(self) -> EnvSpec:
        """The environment."""
        return self.roles[self.selector].spec


def joint_task(selector: str, roles: Mapping[str, Role], who: Calling) -> JointTask:
    """Return the learning task of a selector that calls skills, of which some learn, too.

    Args:
        selector: its path.
        roles: of its level, and of levels below it, by path.
        who: acts.
    """
    role = roles[selector]
    return JointTask(
        role.spec.name,
        role.observation_space,
        role.action_space,
        skill_task(agent_role(role.spec)).collector,
        role.row_steps,
        called=_called(role.spec, who),
        selector=selector,
        roles=roles,
        who=who,
    )
