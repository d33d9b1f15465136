"""The learning task of a stage: its learner and acting policies, environments and collectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skillweave.envs.engine import Engine, GymnasiumEngine
from skillweave.envs.make import make_engine
from skillweave.experience.acting import Acting
from skillweave.experience.collector import Collector
from skillweave.experience.learners import Alone, Calling
from skillweave.experience.search import Starts
from skillweave.skills import Reflex
from skillweave.skills.skill_set import SkillSet
from skillweave.training.role import Role


@dataclass(frozen=True)
class LearningTask:
    """The learning task of a stage, and the policies that act in its environments."""

    role: Role
    """The role that learns; of a hierarchy that learns together, its selector."""
    who: Alone | Calling
    """The acting policies; a guide may decide in the selector's place."""
    roles: Mapping[str, Role] | None = None
    """The roles of a level that learns together, and of those below it, by path; None: one learns
    alone."""
    log_info: tuple[str, ...] = ()
    """Keys of ``info`` that collectors of learners log."""
    log_calls: tuple[str, ...] | None = None
    """Keys of ``info`` in the log of calls; None: none is kept."""

    @property
    def skills(self) -> SkillSet | None:
        """The skills called in the outermost hierarchy; None: it is the task of another learner."""
        who = self.who
        return who.skills if isinstance(who, Calling) and who.skill is None else None

    def engine(self, num_envs: int, first: int = 0) -> Engine:
        """Return ``num_envs`` environments; ``first`` is the number of the first, for messages."""
        return make_engine(self.role.spec, num_envs, first=first)

    def collector(self, num_envs: int, acting: Acting | None, first: int = 0) -> Collector:
        """Return a collector of one learner; ``acting`` None: nobody acts in it itself."""
        return self.logged(Collector(self.engine(num_envs, first), acting, self.who))

    def logged(self, collector: Collector) -> Collector:
        """Return a learner's collector, which logs what is to be logged."""
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
        role: the role that learns.
        reflexes: in force while it acts.
        starts: how calls of the skill start; None: wherever it may.
        limit: the most steps of a call; None: the skill's own limit.
    """
    who = Alone(role.skill, tuple(reflexes), role.part, starts or Starts(), limit)
    return LearningTask(role, who)
