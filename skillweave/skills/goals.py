"""Goals of skills: drawn, checked, and joined with observations.

A skill with a goal is one policy for many tasks: its networks see the observation and the goal
(universal value functions, Schaul et al. 2015). What they see is an element of
``goal_spaces.with_goal``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from skillweave.errors import DeclarationError, EnvError, SkillError, SkillweaveError
from skillweave.messages import short
from skillweave.policies.hierarchy import TRIES, goals_hold
from skillweave.policies.parts import joined
from skillweave.policies.spaces import space_of
from skillweave.skills.base import Skill, path_of
from skillweave.skills.goal_spaces import repeated
from skillweave.skills.outputs import called
from skillweave.types import Array, read_only


def goals_of(skill: Skill | None) -> Goals | None:
    """Return the goals of a skill; None: it has none."""
    return None if skill is None or skill.goal_space is None else Goals(skill)


class Goals:
    """The goals of one skill.

    Args:
        skill: with a ``goal_space``.

    Raises:
        DeclarationError: its space is not supported.
    """

    def __init__(self, skill: Skill) -> None:
        from skillweave.spaces.packing import obs_dtype  # needs torch

        space = skill.goal_space
        assert space is not None
        self.skill, self.space = skill, space
        self._who = f"skill {path_of(skill)!r}"
        self._label = f"{self._who}: goals()"
        try:
            obs_dtype(space)
        except EnvError as error:
            text = str(error).replace("observation space", "goal_space").split(". ")[0]
            text = f"goal_{text}" if text.startswith("space ") else text
            raise DeclarationError(f"{self._who}: {text}") from error
        self.data = space_of(space)
        """The space as data."""
        self.size = self.data.size
        """The numbers of a goal."""
        if not self.size:
            raise DeclarationError(
                f"{self._who}: goal_space is {short(space)}, which holds no number: leave it out"
            )

    def start(self, n: int) -> Array:
        """Return goals of n environments without a call, (n, *goal_shape)."""
        return self.data.start(n)

    def contains(self, goal: Array) -> bool:
        """Return whether all goals (n, *goal_shape) are in the space."""
        return bool(self.data.holds(goal).all())

    def join(self, obs: Array, goal: Array) -> Array:
        """Return what the skill's networks see: one array (…) of observations and goals.

        Args:
            obs: (…, *obs_shape).
            goal: (…, *goal_shape).
        """
        return joined(obs, goal, goal.ndim - len(self.data.shape))

    def draw(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return goals to practise in observations ``obs`` (n, …), from ``Skill.goals``.

        Goals that hold already are drawn again, at most ``TRIES`` times.

        Raises:
            SkillError: the skill's ``goals`` failed, or returned something else.
        """
        goal, rows = self.start(len(obs)), np.arange(len(obs))
        for _ in range(TRIES):
            given = called(self.skill.goals, read_only(obs), self._label, more=(rng,))
            goal[rows] = self.fitted(obs, given, self._label)
            again = self.hold(obs, goal[rows])
            if not again.any():
                break
            obs, rows = obs[again], rows[again]
        return goal

    def hold(self, obs: Array, goal: Array) -> Array:
        """Return the goals (n, *goal_shape) for which a call would end at once, (n,) bool.

        See ``policies.hierarchy.goals_hold``.
        """
        ask = partial(called, self.skill.termination, who=self._label, judges=None)
        return goals_hold(ask, obs, goal)

    def fitted(
        self, obs: Array, goal: Any, who: str, kind: type[SkillweaveError] = SkillError
    ) -> Array:
        """Return goals for calls that start in ``obs`` (n, …), checked, as (n, *goal_shape).

        Args:
            goal: of each of the n environments.
            who: whose goals they are, for messages.
            kind: the type of the error.

        Raises:
            SkillError: they have another shape or type, or are out of the space, where the skill
                does not clip them.
        """
        goals = self.data.goals(goal, len(obs), who, self._who, kind)
        if self.skill.defines("clip_goal"):
            who, kind = f"{self._who}: clip_goal()", SkillError
            clipped = called(self.skill.clip_goal, read_only(obs), who, more=(read_only(goals),))
            goals = self.data.goals(clipped, len(obs), who, self._who)
        return self._inside(goals, who, kind)

    def _inside(self, goals: Array, who: str, kind: type[SkillweaveError]) -> Array:
        """Return goals that are in the space."""
        if not (inside := self.data.holds(goals)).all():
            advice = "" if self.skill.defines("clip_goal") else f"; {ADVICE}"
            raise kind(self.data.is_out(goals[inside.argmin()], who, self._who) + advice)
        return goals

    def one(self, goal: Any, who: str) -> Array:
        """Return a copy of one goal as a batch of one, checked.

        Whether it is in the space is left to ``fitted`` where the skill clips goals, which needs
        an observation.

        Raises:
            SkillError: it is none of the space; the message names ``who``.
        """
        batch, wanted = repeated(self.space, goal, 1), (1, *self.data.shape)
        if self.data.parts is None and isinstance(batch, np.ndarray) and batch.shape != wanted:
            raise SkillError(
                f"{who} gave a goal of shape {batch.shape[1:]} for {self._who}, but "
                f"{self.data.shape} was expected: one of {short(self.space)}"
            )
        goals = self.data.goals(batch, 1, who, self._who).copy()
        return goals if self.skill.defines("clip_goal") else self._inside(goals, who, SkillError)


ADVICE = "give one in it, or let the skill move goals into it: clip_goal(obs, goal)"
