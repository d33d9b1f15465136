"""Whether the methods of a skill read the goal of a step."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from skillweave._internal.notices import notice
from skillweave.errors import SkillweaveError
from skillweave.skills.base import Skill, path_of
from skillweave.skills.outputs import called
from skillweave.skills.probing import first_time, untouched
from skillweave.types import Step


class _Watched(Step):
    """A step that notes whether its goal is read."""

    reads = False

    @property
    def goal(self) -> Any:
        """Return the goal, and note that it was read."""
        self.reads = True
        return self._goal

    @goal.setter
    def goal(self, value: Any) -> None:
        self._goal = value


def is_unchecked(skill: Skill) -> bool:
    """Return True once for each skill."""
    return first_time(skill, "its goal")


def check_reads_goal(skill: Skill, step: Step) -> None:
    """Give a notice where neither reward, termination nor success of a skill reads its goal.

    It would learn to ignore its goal.

    Args:
        step: some steps of the skill, with goals.
    """
    if skill.reward_changes:
        return
    watched = _Watched(**{field.name: getattr(step, field.name) for field in fields(Step)})
    watched.reads = False
    try:
        for method in filter(skill.defines, ("reward", "termination", "success")):
            who = f"skill {path_of(skill)!r}: {method}()"
            with untouched(skill):  # it leaves no traces
                called(getattr(skill, method), watched, who, judges=None)
    except SkillweaveError:
        return  # it is raised where the step is judged
    if not watched.reads:
        notice(
            f"skill {path_of(skill)!r} has goals, but its reward(), termination() and success() "
            "are the same for every goal: none reads step.goal, so the skill learns to ignore its "
            "goal. Let its reward depend on step.goal, or leave out goal_space"
        )
