"""Goals of skills: drawn, checked, joined with observations, and whether a skill reads them.

A skill with a goal is one policy for many tasks: its networks see the observation and the goal
(universal value functions, Schaul et al. 2015). What they see is an element of
``goal_spaces.with_goal``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, EnvError, SkillError, SkillweaveError
from skillweave.policies.core import Array, Step, read_only
from skillweave.policies.hierarchy import TRIES, CallGoals
from skillweave.policies.parts import joined
from skillweave.policies.spaces import space_of
from skillweave.skills.base import Skill, path_of
from skillweave.skills.function_state import untouched
from skillweave.skills.goal_spaces import alone
from skillweave.skills.outputs import call_user


def goals_of(skill: Skill | None) -> Goals | None:
    """Return the goals of a skill; None: it has none."""
    return None if skill is None or skill.goal_space is None else Goals(skill)


class Goals(CallGoals):
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
        self.skill = skill
        self.goal_space = space
        self._who = f"skill {path_of(skill)!r}"
        self._label = f"{self._who}: goals()"
        try:
            obs_dtype(space)
        except EnvError as error:
            text = str(error).replace("observation space", "goal_space").split(". ")[0]
            text = f"goal_{text}" if text.startswith("space ") else text
            raise DeclarationError(f"{self._who}: {text}") from error
        clip = self._clip if skill.defines("clip_goal") else None
        super().__init__(path_of(skill), space_of(space), clip)
        if not self.space.size:
            raise DeclarationError(
                f"{self._who}: goal_space is {short(space)}, which holds no number: leave it out"
            )

    def _clip(self, obs: Array, goals: Array) -> Any:
        who = f"{self._who}: clip_goal()"
        return call_user(self.skill.clip_goal, read_only(obs), who, more=(read_only(goals),))

    def join(self, obs: Array, goal: Array) -> Array:
        """Return the input of the skill's networks: one array (…) of observations and goals.

        Args:
            obs: (…, *obs_shape).
            goal: (…, *goal_shape).
        """
        return joined(obs, goal, goal.ndim - len(self.space.shape))

    def draw(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return goals to practise in observations ``obs`` (n, …), from ``Skill.goals``.

        Goals that hold already are drawn again, at most ``TRIES`` times.

        Raises:
            SkillError: the skill's ``goals`` failed, or returned something else.
        """
        goal, rows = self.start(len(obs)), np.arange(len(obs))
        for _ in range(TRIES):
            given = call_user(self.skill.goals, read_only(obs), self._label, fixed=(rng,))
            goal[rows] = self.fitted(obs, given, self._label)
            again = self.hold(obs, goal[rows], self.skill.termination)
            if not again.any():
                break
            obs, rows = obs[again], rows[again]
        return goal

    def one(self, goal: Any, who: str) -> Array:
        """Return a copy of one goal as a batch of one, checked.

        Whether it is in the space is left to ``fitted`` where the skill clips goals, which needs
        an observation.

        Raises:
            SkillError: it is none of the space; the message names ``who``.
        """
        space = self.space
        batch = alone(self.space, goal)
        wrong = isinstance(batch, np.ndarray) and batch.shape != (1, *space.shape)
        if space.parts is None and wrong:
            raise SkillError(
                f"{who} gave a goal of shape {batch.shape[1:]} for {self._who}, but "
                f"{space.shape} was expected: one of {short(self.goal_space)}"
            )
        goals = space.goals(batch, 1, who, self._who).copy()
        return goals if self.clip is not None else self.inside(goals, who)


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


def check_reads_goal(skill: Skill, step: Step) -> None:
    """Give a notice where neither reward, termination nor success of a skill reads its goal.

    It would learn to ignore its goal.

    Args:
        step: some steps of the skill, with goals.
    """
    if not skill.reward_changes and not reads_goal(skill, step):
        notice(
            f"skill {path_of(skill)!r} has goals, but its reward(), termination() and success() "
            "are the same for every goal: none reads step.goal, so the skill learns to ignore its "
            "goal. Let its reward depend on step.goal, or leave out goal_space"
        )


JUDGES = ("reward", "termination", "success")
"""The methods of a skill that judge a step."""


def reads_goal(skill: Skill, step: Step, methods: Sequence[str] = JUDGES) -> bool:
    """Return whether methods of a skill that judge a step read its goal.

    Where one of them fails, it does: that is raised where the step is judged.
    """
    watched = _Watched(**{field.name: getattr(step, field.name) for field in fields(Step)})
    watched.reads = False
    try:
        for method in filter(skill.defines, methods):
            who = f"skill {path_of(skill)!r}: {method}()"
            with untouched(skill):  # it leaves no traces
                call_user(getattr(skill, method), watched, who, judges=None)
    except SkillweaveError:
        return True
    return watched.reads
