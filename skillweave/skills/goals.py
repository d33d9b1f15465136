"""Goals of skills: drawn, checked, joined with observations, and stored in memories.

A skill with a goal is one policy for many tasks: its networks see the observation and the goal
(universal value functions, Schaul et al. 2015). What they see is an element of
``goal_spaces.with_goal``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave.errors import DeclarationError, EnvError, SkillError, SkillweaveError
from skillweave.messages import short
from skillweave.skills.base import Skill, path_of
from skillweave.skills.goal_spaces import (
    GOAL,
    OBSERVATION,
    batch_of_one,
    example_of,
    joint_dtype,
    leaf_paths,
    limits_of,
    outside,
    part_at,
)
from skillweave.skills.outputs import as_array, called
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
        from skillweave.spaces.packing import obs_dtype, obs_shape, pack  # needs torch

        space = skill.goal_space
        assert space is not None
        self._pack = pack
        self.skill, self.space = skill, space
        self._who = f"skill {path_of(skill)!r}"
        try:
            self.dtype, self.shape = obs_dtype(space), obs_shape(space)
        except EnvError as error:
            text = str(error).replace("observation space", "goal_space").split(". ")[0]
            raise DeclarationError(f"{self._who}: {text}") from error
        self._one = example_of(space)
        self._bytes = self.dtype.fields is not None
        self.size = sum(part_at(self._one, path).size for path in leaf_paths(space))
        """The numbers of a goal."""

    def start(self, n: int) -> Array:
        """Return the goals of n environments without a call, as a memory stores them."""
        return self.stored(np.repeat(self._one[None], n, axis=0))

    def stored(self, goal: Array) -> Array:
        """Return goals (n, *goal_shape) as a memory stores them: numbers, or bytes of a Dict."""
        if not self._bytes:
            return goal
        return np.ascontiguousarray(goal).view(np.uint8).reshape(len(goal), self.dtype.itemsize)

    def read(self, stored: Array) -> Array:
        """Return stored goals as arrays (n, *goal_shape)."""
        if not self._bytes:
            return stored
        return np.ascontiguousarray(stored).view(self.dtype).reshape(len(stored))

    def contains(self, stored: Array) -> bool:
        """Return whether all stored goals are in the space."""
        return outside(self.space, self.read(stored)) is None

    def join(self, obs: Array, goal: Array) -> Array:
        """Return what the skill's networks see: one array (…) of observations and goals.

        Args:
            obs: (…, *obs_shape).
            goal: (…, *goal_shape).
        """
        lead = goal.shape[: goal.ndim - len(self.shape)]
        # Zeros, because the bytes between parts are written to files.
        joint = np.zeros(
            lead, joint_dtype(obs.dtype, obs.shape[len(lead) :], self.dtype, self.shape)
        )
        joint[OBSERVATION], joint[GOAL] = obs, goal
        return joint

    def draw(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return goals to practise in observations ``obs`` (n, …), from ``Skill.goals``.

        Raises:
            SkillError: the skill's ``goals`` failed, or returned something else.
        """
        given = called(lambda seen: self.skill.goals(seen, rng), read_only(obs), self._label)
        return self.fitted(obs, given, self._label)

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
        goals = self._as_goals(goal, len(obs), who, kind)
        if self.skill.defines("clip_goal"):
            who, kind = f"{self._who}: clip_goal()", SkillError
            goals = self._as_goals(self._clipped(obs, goals, who), len(obs), who, kind)
        if (row := outside(self.space, goals)) is not None:
            advice = "; give one in it, or let the skill move goals into it: clip_goal(obs, goal)"
            raise kind(
                f"{who} gave the goal {short(goals[row].tolist())}, which is out of goal_space "
                f"{short(self.space)} of {self._who}"
                + ("" if self.skill.defines("clip_goal") else advice)
            )
        return goals

    def _clipped(self, obs: Array, goal: Array, who: str) -> Any:
        return called(lambda seen: self.skill.clip_goal(seen, read_only(goal)), read_only(obs), who)

    def one(self, goal: Any) -> Any:
        """Return one goal as a batch of one; it is not checked yet."""
        if isinstance(goal, Mapping | tuple) and self._bytes:
            return self._pack(self.space, batch_of_one(self.space, goal))
        return np.asarray(goal)[None]

    def flat(self, goal: Array) -> Array:
        """Return goals as numbers (n, G), for policies that take them so."""
        if not self._bytes:
            return goal.reshape(len(goal), self.size).astype(np.float64, copy=False)
        columns = (part_at(goal, path) for path in leaf_paths(self.space))
        flat = [x.reshape(len(goal), math.prod(x.shape[1:])).astype(np.float64) for x in columns]
        return np.concatenate(flat, axis=1)

    @property
    def _label(self) -> str:
        return f"{self._who}: goals()"

    def _as_goals(self, goal: Any, n: int, who: str, kind: type[SkillweaveError]) -> Array:
        wanted = (n, *self.shape)
        gave = f"{who} returned" if who.endswith(")") else f"{who} gave goals of"
        if goal is None:
            raise kind(
                f"{who} returned None, but goals {wanted} were expected: is a return missing?"
            )
        if self._bytes and not isinstance(goal, np.ndarray):
            try:
                goals = self._pack(self.space, goal)
            except (KeyError, TypeError, ValueError, IndexError) as error:
                raise kind(
                    f"{who} returned {short(goal)}, which are no goals of {self.space}"
                ) from error
        else:
            goals = as_array(goal, who, kind)
        if goals.shape != wanted:
            raise kind(
                f"{gave} shape {goals.shape}, but {wanted} was expected: one goal of "
                f"{short(self.space)} for each of the {n} environments"
            )
        if goals.dtype == self.dtype:
            return goals
        whole = self.dtype.kind in "iub"
        if self._bytes or goals.dtype.kind not in ("iub" if whole else "iubf"):
            numbers = "whole numbers" if whole else "numbers"
            wanted_type = self.dtype if self._bytes else numbers
            raise kind(f"{gave} {goals.dtype}, but goals of {short(self.space)} are {wanted_type}")
        if whole and goals.size:
            limits = (0, 1) if self.dtype == bool else limits_of(self.dtype)
            if (goals < limits[0]).any() or (goals > limits[1]).any():
                raise kind(f"{who} returned goals that are no {self.dtype}")
        return goals.astype(self.dtype)
