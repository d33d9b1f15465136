"""Judging: the only place that calls a skill's reward, termination and success on transitions."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from skillweave.envs.infos import reported_success
from skillweave.policies.core import own_step, part_of
from skillweave.skills import Skill, asked
from skillweave.types import Array, Step


class Outcome:
    """The outcome of n steps for a skill; each of its methods is called when first needed.

    Args:
        skill: None for the task itself: the environment's own reward and ends.
        step: as the skill sees it; see ``seen_by``.
        ids: (n,) the environments, for messages; None: all n.
    """

    def __init__(self, skill: Skill | None, step: Step, ids: Array | None = None) -> None:
        self._skill, self._step, self._ids = skill, step, ids

    @cached_property
    def reward(self) -> Array:
        """(n,) float32."""
        return self._step.reward if self._skill is None else self._asked(self._skill, "reward")

    @cached_property
    def stops(self) -> Array:
        """(n,) bool, the skill's own termination() is true."""
        if self._skill is None or not self._skill.defines("termination"):
            return np.zeros(len(self._step.reward), bool)
        return self._asked(self._skill, "termination")

    @cached_property
    def terminated(self) -> Array:
        """(n,) bool, the value of what follows is 0."""
        terminated: Array = self._step.terminated | self.stops
        return terminated

    @cached_property
    def truncated(self) -> Array:
        """(n,) bool, cut by a time limit, the environment's or the skill's; never if terminated."""
        truncated: Array = (self._step.truncated | self._step.timed_out) & ~self.terminated
        return truncated

    @cached_property
    def success(self) -> Array | None:
        """(n,) bool; of the task float64, NaN where unknown; None: the skill defines none."""
        if self._skill is None:
            return reported_success(self._step.info, len(self._step.reward))
        return self._asked(self._skill, "success") if self._skill.defines("success") else None

    def _asked(self, skill: Skill, method: str) -> Array:
        return asked(skill, method, self._step, self._ids)


def judge(skill: Skill | None, step: Step, ids: Array | None = None) -> Outcome:
    """Judge n steps by a skill; the arguments are those of ``Outcome``."""
    return Outcome(skill, step, ids)


def seen_by(
    skill: Skill | None,
    step: Step,
    elapsed: Array,
    rows: Array | None = None,
    goal: Array | None = None,
) -> Step:
    """Return a step as a skill sees it, whose calls have their own time.

    Where the environment is scored by a task, a skill sees the environment's own reward.

    Args:
        skill: None: there is no limit, and the reward is the task's.
        elapsed: (m,) steps of its calls so far, this one included.
        rows: (m,) ascending, some rows of the step; None: all.
        goal: (m, *goal_shape) of its calls; None: it has no goals.
    """
    if skill is None:
        return part_of(step, elapsed, rows, None, goal)
    return part_of(own_step(step), elapsed, rows, skill.max_steps, goal)
