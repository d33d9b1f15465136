"""Goals of skills: drawn, checked, and joined with observations.

A skill with a goal is one policy for many tasks: its networks see the observation and the goal
(universal value functions, Schaul et al. 2015). What they see is an element of
``goal_spaces.with_goal``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Tuple

from skillweave.errors import DeclarationError, EnvError, SkillError, SkillweaveError
from skillweave.messages import short
from skillweave.policies.hierarchy import TRIES
from skillweave.policies.parts import GOAL, OBSERVATION, joined, joint_dtype
from skillweave.skills.base import Skill, path_of
from skillweave.skills.goal_spaces import (
    example_of,
    given_parts,
    goals_space,
    in_words,
    leaf_paths,
    numbers_in,
    outside,
    part_at,
    parts_of,
    repeated,
)
from skillweave.skills.outputs import called
from skillweave.types import Array, Step, read_only


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
        from skillweave.spaces.packing import obs_dtype, obs_shape  # needs torch

        space = skill.goal_space
        assert space is not None
        self.skill, self.space = skill, space
        self._who = f"skill {path_of(skill)!r}"
        try:
            self.dtype, self.shape = obs_dtype(space), obs_shape(space)
        except EnvError as error:
            text = str(error).replace("observation space", "goal_space").split(". ")[0]
            text = f"goal_{text}" if text.startswith("space ") else text
            raise DeclarationError(f"{self._who}: {text}") from error
        self._one = example_of(space)
        self.size = numbers_in(space)
        """The numbers of a goal."""
        if not self.size:
            raise DeclarationError(
                f"{self._who}: goal_space is {short(space)}, which holds no number: leave it out"
            )

    def start(self, n: int) -> Array:
        """Return goals of n environments without a call, (n, *goal_shape)."""
        return np.repeat(self._one[None], n, axis=0)

    def contains(self, goal: Array) -> bool:
        """Return whether all goals (n, *goal_shape) are in the space."""
        return outside(self.space, goal) is None

    def join(self, obs: Array, goal: Array) -> Array:
        """Return what the skill's networks see: one array (…) of observations and goals.

        Args:
            obs: (…, *obs_shape).
            goal: (…, *goal_shape).
        """
        return joined(obs, goal, goal.ndim - len(self.shape))

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

        For them ``termination`` is true for a step that stands still in ``obs`` (n, …). Where it
        fails for such a step, as it reads ``info`` for example, no goal holds.
        """
        zeros, ones = np.zeros(len(obs), np.float32), np.ones(len(obs), np.int64)
        no = zeros > 0
        still = Step(obs, zeros, obs, zeros, no, no, no, ones, {}, goal)
        with suppress(Exception), np.errstate(all="ignore"):
            holds = called(self.skill.termination, still, self._label, judges=None)
            return np.array(holds, bool).reshape(len(obs))
        return no

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
        goals = as_goals(goal, len(obs), self.space, who, self._who, kind)
        if self.skill.defines("clip_goal"):
            who, kind = f"{self._who}: clip_goal()", SkillError
            goals = as_goals(
                self._clipped(obs, goals, who), len(obs), self.space, who, self._who, kind
            )
        return self._inside(goals, who, kind)

    def _inside(self, goals: Array, who: str, kind: type[SkillweaveError]) -> Array:
        """Return goals that are in the space."""
        if (row := outside(self.space, goals)) is not None:
            advice = "" if self.skill.defines("clip_goal") else f"; {ADVICE}"
            raise kind(_is_out(goals[row], self.space, who, self._who) + advice)
        return goals

    def _clipped(self, obs: Array, goal: Array, who: str) -> Any:
        return called(self.skill.clip_goal, read_only(obs), who, more=(read_only(goal),))

    def one(self, goal: Any, who: str) -> Array:
        """Return a copy of one goal as a batch of one, checked.

        Whether it is in the space is left to ``fitted`` where the skill clips goals, which needs
        an observation.

        Raises:
            SkillError: it is none of the space; the message names ``who``.
        """
        if parts_of(self.space) is None and (shape := _shape_of(goal)) not in (None, self.shape):
            raise SkillError(
                f"{who} gave a goal of shape {shape} for {self._who}, but {self.shape} was "
                f"expected: one of {short(self.space)}"
            )
        goals = as_goals(repeated(self.space, goal, 1), 1, self.space, who, self._who).copy()
        return goals if self.skill.defines("clip_goal") else self._inside(goals, who, SkillError)

    def flat(self, goal: Array) -> Array:
        """Return goals as numbers (n, G), for policies that take them so."""
        if self.dtype.fields is None:
            return goal.reshape(len(goal), self.size).astype(np.float64, copy=False)
        columns = (part_at(goal, path) for path in leaf_paths(self.space))
        flat = [x.reshape(len(goal), math.prod(x.shape[1:])).astype(np.float64) for x in columns]
        return np.concatenate(flat, axis=1)

    @property
    def _label(self) -> str:
        return f"{self._who}: goals()"


class CallGoals:
    """The goals of a level's skills beside observations, as its critic of skills sees them.

    Only the goal of the running skill counts; the others are ``example_of`` their spaces.

    Args:
        goals: of the skills that have some, by their places in the list.
    """

    def __init__(self, goals: Mapping[int, Goals]) -> None:
        self._goals = dict(goals)
        space = goals_space({of.skill.name: of.space for of in goals.values()})
        self._blank = example_of(space)

    def join(self, obs: Array, running: Array, goals: Mapping[int, Array]) -> Array:
        """Return observations and goals as one array (…).

        Args:
            obs: (…, *obs_shape).
            running: (…) int64, the running skills.
            goals: by place, (…, *goal_shape) of the latest calls; one that is missing has no call.
        """
        lead = running.shape
        whole = self._blank.dtype, ()
        joint = np.zeros(lead, joint_dtype(obs.dtype, obs.shape[len(lead) :], *whole))
        joint[OBSERVATION], joint[GOAL] = obs, self._blank
        for i, values in goals.items():
            runs = running == i
            joint[GOAL][self._goals[i].skill.name][runs] = values[runs]
        return joint


ADVICE = "give one in it, or let the skill move goals into it: clip_goal(obs, goal)"


def as_goals(
    values: Any,
    n: int,
    space: Space[Any],
    who: str,
    skill: str,
    kind: type[SkillweaveError] = SkillError,
    rows: Array | None = None,
) -> Array:
    """Return goals as an array of the space's type, (n, *goal_shape); no number changes.

    Whether they are in the space is not checked beyond that.

    Args:
        values: (n, *goal_shape); of a Dict or Tuple also dicts and tuples of such arrays.
        who: whose goals they are, for messages.
        skill: which is given them, for messages.
        kind: the type of the error.
        rows: the environments (k,) whose goals are returned, (k, *goal_shape); None: all. The
            goals of the others may be anything.

    Raises:
        SkillError: they have another shape or type, or a number that the type cannot hold.
    """
    from skillweave.spaces.packing import obs_dtype, obs_shape  # needs torch

    dtype, wanted = obs_dtype(space), (n, *obs_shape(space))
    if values is None:
        raise kind(f"{who} returned None, but goals {wanted} were expected: is a return missing?")
    inner = parts_of(space)
    if inner is not None and not isinstance(values, np.ndarray):
        given = given_parts(space, values)
        if given is None or (isinstance(space, Tuple) and isinstance(values, Mapping)):
            has, expected = in_words(space, values, "part")
            raise kind(
                f"{who} gave {has} as goals of {skill}, but {expected} was expected: its goals are "
                f"of {short(space)}"
            )
        packed = np.zeros(n if rows is None else len(rows), dtype)
        for name, part in inner.items():
            whose = f"the part {name!r} of {skill}"
            packed[name] = as_goals(given[name], n, part, who, whose, kind, rows)
        return packed
    try:
        goals = np.asarray(values)
    except ValueError as error:  # of parts of unequal lengths
        raise kind(
            f"{who} gave {short(values)}, which are no goals of {short(space)} of {skill}: the "
            f"shape {wanted} was expected"
        ) from error
    if goals.shape != wanted:
        raise kind(
            f"{who} gave goals of shape {goals.shape} for {skill}, but {wanted} was expected: one "
            f"goal of {short(space)} for "
            + ("one environment" if n == 1 else f"each of the {n} environments")
        )
    goals = goals if rows is None else goals[rows]
    if goals.dtype == dtype:
        return goals
    whole = dtype.kind in "iub"
    if inner is not None or goals.dtype.kind not in ("iub" if whole else "iubf"):
        needed = dtype if inner is not None else "whole numbers" if whole else "numbers"
        raise kind(
            f"{who} gave goals of {goals.dtype} for {skill}, but goals of {short(space)} are "
            f"{needed}"
        )
    if whole and goals.size:
        low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        wrong = ((goals < low) | (goals > high)).reshape(len(goals), -1).any(axis=1)
        if wrong.any():
            raise kind(_is_out(goals[wrong.argmax()], space, who, skill) + "; give one in it")
    with np.errstate(over="ignore"):  # an infinity is out of every space
        return goals.astype(dtype)


def _shape_of(value: Any) -> tuple[int, ...] | None:
    """Return the shape of a goal; None: it is no array."""
    try:
        shape: tuple[int, ...] = np.shape(value)
        return shape
    except ValueError:
        return None


def _is_out(goal: Array, space: Space[Any], who: str, skill: str) -> str:
    return (
        f"{who} gave the goal {short(goal.tolist())}, which is out of goal_space {short(space)} of "
        f"{skill}"
    )
