"""Goals of skills: drawn, checked, joined with observations, and stored in memories.

A skill with a goal is one policy for many tasks: its networks see the observation and the goal
(universal value functions, Schaul et al. 2015). What they see is an element of ``with_goal``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.errors import DeclarationError, EnvError, SkillError, SkillweaveError
from skillweave.messages import short
from skillweave.skills.base import Skill, path_of
from skillweave.skills.outputs import as_array, called
from skillweave.types import Array, read_only

OBSERVATION, GOAL = "observation", "goal"
"""The parts of what a skill with a goal observes."""


def with_goal(observation_space: gym.Space[Any], goal_space: gym.Space[Any]) -> gym.spaces.Dict:
    """Return the space of what a skill with a goal observes: the observation and the goal."""
    return gym.spaces.Dict([(OBSERVATION, observation_space), (GOAL, goal_space)])


def without_goal(observation_space: gym.Space[Any]) -> gym.Space[Any]:
    """Return the observation's part of a space of ``with_goal``."""
    assert isinstance(observation_space, gym.spaces.Dict)
    return observation_space[OBSERVATION]


def goal_part(observation_space: gym.Space[Any]) -> gym.Space[Any]:
    """Return the goal's part of a space of ``with_goal``."""
    assert isinstance(observation_space, gym.spaces.Dict)
    return observation_space[GOAL]


SKILL = "skill"
"""The part of a choice that names the skill; ``GOAL`` has a goal for each skill with goals."""


def choice_space(
    choices: int, goal_spaces: Mapping[str, gym.Space[Any]], skills: Sequence[str]
) -> gym.Space[Any]:
    """Return the space of a selector's choices: numbers, or numbers and goals.

    Args:
        choices: the number of skills, times lengths where these are chosen, too.
        goal_spaces: of the skills that have goals, by their names.
        skills: the names of all skills, in order.
    """
    if not goal_spaces:
        return gym.spaces.Discrete(choices)
    from skillweave.spaces.choices import ChoiceSpace  # needs torch, which declaring does not

    each = choices // len(skills)
    first = {name: each * skills.index(name) for name in goal_spaces}
    owners = {name: (start, start + each) for name, start in first.items()}
    return ChoiceSpace(choices, goal_spaces, owners)


def number_of(choice: Array) -> Array:
    """Return the numbers (k,) of choices (k,) with or without goals."""
    return choice if choice.dtype.fields is None else choice[SKILL]


def blank_choices(space: gym.Space[Any], number: Array) -> Array:
    """Return choices of a ``choice_space`` with these numbers (k,), and some goals, to be set."""
    if isinstance(space, gym.spaces.Discrete):
        return number
    choice = np.repeat(_example(space)[None], len(number), axis=0)
    choice[SKILL] = number
    return choice


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
        self._one = _example(space)
        self._bytes = self.dtype.fields is not None
        self.size = sum(_part(self._one, path).size for path in _leaf_paths(space))
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

    def join(self, obs: Array, goal: Array) -> Array:
        """Return what the skill's networks see: one array (…) of observations and goals.

        Args:
            obs: (…, *obs_shape).
            goal: (…, *goal_shape).
        """
        lead = goal.shape[: goal.ndim - len(self.shape)]
        # Zeros, because the bytes between parts are written to files.
        joint = np.zeros(lead, _joint_dtype(obs.dtype, obs.shape[len(lead) :], self))
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
        if (row := _outside(self.space, goals)) is not None:
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
            return self._pack(self.space, _batch_of_one(self.space, goal))
        return np.asarray(goal)[None]

    def flat(self, goal: Array) -> Array:
        """Return goals as numbers (n, G), for policies that take them so."""
        if not self._bytes:
            return goal.reshape(len(goal), -1).astype(np.float64, copy=False)
        columns = (_part(goal, path) for path in _leaf_paths(self.space))
        flat = [x.reshape(len(goal), -1).astype(np.float64) for x in columns]
        return np.concatenate(flat, axis=1)

    @property
    def _label(self) -> str:
        return f"{self._who}: goals()"

    def _as_goals(self, goal: Any, n: int, who: str, kind: type[SkillweaveError]) -> Array:
        wanted = (n, *self.shape)
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
                f"{who} returned shape {goals.shape}, but {wanted} was expected: one goal of "
                f"{short(self.space)} for each of the {n} environments"
            )
        if goals.dtype == self.dtype:
            return goals
        whole = self.dtype.kind in "iub"
        if self._bytes or goals.dtype.kind not in ("iub" if whole else "iubf"):
            numbers = "whole numbers" if whole else "numbers"
            wanted_type = self.dtype if self._bytes else numbers
            raise kind(
                f"{who} returned {goals.dtype}, but goals of {short(self.space)} are {wanted_type}"
            )
        if whole and goals.size:
            limits = (0, 1) if self.dtype == bool else _limits(self.dtype)
            if (goals < limits[0]).any() or (goals > limits[1]).any():
                raise kind(f"{who} returned goals that are no {self.dtype}")
        return goals.astype(self.dtype)


MOST_SHOWN = 6
"""The most numbers of a goal that captions show."""


def shown_goal(goal: Array) -> str:
    """Return one goal as short text for captions: ``(0.3, -1)``."""
    if goal.dtype.names:
        return "(" + ", ".join(f"{k} {shown_goal(goal[k])}" for k in goal.dtype.names) + ")"
    values = [f"{x:.3g}" for x in np.asarray(goal).reshape(-1)[:MOST_SHOWN].tolist()]
    if goal.size > MOST_SHOWN:
        return f"({goal.size} numbers)"
    return f"({', '.join(values)})" if goal.ndim else values[0]


def draw_from(space: gym.Space[Any], n: int, rng: np.random.Generator) -> Array:
    """Draw n elements of a space as one batch: uniformly where it is bounded."""
    from skillweave.spaces.packing import obs_dtype  # needs torch, which declaring does not

    inner = _parts(space)
    if inner is not None:
        drawn = np.zeros(n, obs_dtype(space))
        for name, part in inner.items():
            drawn[name] = draw_from(part, n, rng)
        return drawn
    if isinstance(space, gym.spaces.Discrete):
        return (int(space.start) + rng.integers(int(space.n), size=n)).astype(space.dtype)
    if isinstance(space, gym.spaces.MultiDiscrete):
        start = np.asarray(space.start)
        return (start + rng.integers(space.nvec, size=(n, *space.shape))).astype(space.dtype)
    if isinstance(space, gym.spaces.MultiBinary):
        return rng.integers(2, size=(n, *space.shape)).astype(space.dtype)
    assert isinstance(space, gym.spaces.Box)
    shape = (n, *space.shape)
    if space.dtype.kind in "iub":
        low, high = space.low.astype(np.int64), space.high.astype(np.int64)
        return rng.integers(low, high, size=shape, endpoint=True).astype(space.dtype)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    below, above = np.isfinite(low), np.isfinite(high)
    drawn = rng.standard_normal(shape)
    tail = np.abs(drawn)
    drawn = np.where(below & ~above, low + tail, np.where(above & ~below, high - tail, drawn))
    both = below & above
    if both.any():
        with np.errstate(invalid="ignore", over="ignore"):
            uniform = low + rng.random(shape) * (high - low)
        drawn = np.where(both, uniform, drawn)
    found: Array = drawn.astype(space.dtype).clip(space.low, space.high)
    return found


def _example(space: gym.Space[Any]) -> Array:
    """Return an element of a space: zero where that is in it."""
    from skillweave.spaces.packing import obs_dtype  # needs torch, which declaring does not

    inner = _parts(space)
    if inner is not None:
        found = np.zeros((), obs_dtype(space))
        for name, part in inner.items():
            found[name] = _example(part)
        return found
    if isinstance(space, gym.spaces.Box):
        return np.zeros(space.shape, space.dtype).clip(space.low, space.high)
    start = np.asarray(getattr(space, "start", 0), space.dtype)
    return np.broadcast_to(start, space.shape or ()).copy()


def _outside(space: gym.Space[Any], goals: Array) -> int | None:
    """Return the first row of goals (n, …) that is not in a space; None: all are."""
    inner = _parts(space)
    if inner is not None:
        rows = [_outside(part, goals[name]) for name, part in inner.items()]
        return min((row for row in rows if row is not None), default=None)
    if isinstance(space, gym.spaces.Box):
        inside = (goals >= space.low) & (goals <= space.high)  # False for NaN
        if goals.dtype.kind == "f":
            inside &= np.isfinite(goals)
    elif isinstance(space, gym.spaces.MultiBinary):
        inside = (goals == 0) | (goals == 1)
    else:
        start: Any = np.asarray(space.start)  # type: ignore[attr-defined]
        count: Any = space.nvec if isinstance(space, gym.spaces.MultiDiscrete) else space.n  # type: ignore[attr-defined]
        inside = (goals >= start) & (goals < start + count)
    wrong = ~inside.reshape(len(goals), -1).all(axis=1)
    return int(wrong.argmax()) if wrong.any() else None


def _limits(dtype: np.dtype[Any]) -> tuple[int, int]:
    return int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)


def _parts(space: gym.Space[Any]) -> dict[str, gym.Space[Any]] | None:
    """Return the named parts of a Dict or Tuple; None for any other space."""
    from skillweave.spaces.packing import parts  # needs torch, which declaring does not

    return parts(space) if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple) else None


def _batch_of_one(space: gym.Space[Any], value: Any) -> Any:
    if isinstance(space, gym.spaces.Dict):
        return {name: _batch_of_one(part, value[name]) for name, part in space.spaces.items()}
    if isinstance(space, gym.spaces.Tuple):
        return tuple(_batch_of_one(p, v) for p, v in zip(space.spaces, value, strict=True))
    return np.asarray(value)[None]


def _part(goal: Array, path: tuple[str, ...]) -> Array:
    for name in path:
        goal = goal[name]
    return goal


def _leaf_paths(space: gym.Space[Any], before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    inner = _parts(space)
    if inner is None:
        return [before]
    return [path for name, part in inner.items() for path in _leaf_paths(part, (*before, name))]


def _joint_dtype(obs: np.dtype[Any], shape: tuple[int, ...], goals: Goals) -> np.dtype[Any]:
    """Return the dtype of joint observations, as ``obs_dtype`` of ``with_goal`` has it."""
    return _joint(obs, shape, goals.dtype, goals.shape)


@lru_cache(64)
def _joint(
    obs: np.dtype[Any], shape: tuple[int, ...], goal: np.dtype[Any], goal_shape: tuple[int, ...]
) -> np.dtype[Any]:
    return np.dtype([(OBSERVATION, obs, shape), (GOAL, goal, goal_shape)], align=True)
