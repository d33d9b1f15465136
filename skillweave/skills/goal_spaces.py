"""Spaces with goals: what a skill with goals observes, and elements of a space of goals.

Importing it needs no torch, so that skills can be declared without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from skillweave.messages import short
from skillweave.policies.hierarchy import SKILL
from skillweave.policies.parts import GOAL, OBSERVATION
from skillweave.types import Array


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


def goals_space(goal_spaces: Mapping[str, gym.Space[Any]]) -> gym.spaces.Dict:
    """Return the space of the goals of several skills, by their names."""
    return gym.spaces.Dict(list(goal_spaces.items()))


def other_goals(trained: gym.Space[Any], declared: gym.Space[Any]) -> str:
    """Return the end of a message about a skill that was trained for other goals; "": the same.

    Other bounds are other goals: they say which goals it practised.
    """
    if trained == declared:
        return ""
    return (
        f"was trained for goals of {short(trained, 300)}, but now its goal_space is "
        f"{short(declared, 300)}: declare goal_space as it was, or train again"
    )


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
    choice = np.repeat(example_of(space)[None], len(number), axis=0)
    choice[SKILL] = number
    return choice


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

    inner = parts_of(space)
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


def example_of(space: gym.Space[Any]) -> Array:
    """Return an element of a space: zero where that is in it."""
    from skillweave.spaces.packing import obs_dtype  # needs torch, which declaring does not

    inner = parts_of(space)
    if inner is not None:
        found = np.zeros((), obs_dtype(space))
        for name, part in inner.items():
            found[name] = example_of(part)
        return found
    if isinstance(space, gym.spaces.Box):
        return np.zeros(space.shape, space.dtype).clip(space.low, space.high)
    start = np.asarray(getattr(space, "start", 0), space.dtype)
    return np.broadcast_to(start, space.shape or ()).copy()


def outside(space: gym.Space[Any], goals: Array) -> int | None:
    """Return the first row of goals (n, …) that is not in a space; None: all are."""
    inner = parts_of(space)
    if inner is not None:
        rows = [outside(part, goals[name]) for name, part in inner.items()]
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


def parts_of(space: gym.Space[Any]) -> dict[str, gym.Space[Any]] | None:
    """Return the named parts of a Dict or Tuple; None for any other space."""
    from skillweave.spaces.packing import parts  # needs torch, which declaring does not

    return parts(space) if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple) else None


def given_parts(space: gym.Space[Any], value: Any) -> dict[str, Any] | None:
    """Return the parts of a value of a Dict or Tuple by name; None: its parts are others.

    Those of a tuple or list have their places as names, those of a structured array its fields.
    """
    names, given = parts_of(space) or {}, value
    if isinstance(value, tuple | list) and isinstance(space, gym.spaces.Tuple):
        given = {str(place): part for place, part in enumerate(value)}
    elif isinstance(value, np.ndarray) and value.dtype.names:
        given = {name: value[name] for name in value.dtype.names}
    if not isinstance(given, Mapping) or set(given) != set(names):
        return None
    return {name: given[name] for name in names}


def in_words(space: gym.Space[Any], value: Any, each: Literal["part", "array"]) -> tuple[str, str]:
    """Return what was given in place of parts, and which are expected, for messages.

    Args:
        each: the word for a part.
    """
    names = parts_of(space) or {}
    expected = f"a dict {'with' if each == 'part' else 'of arrays for'} "
    expected += ", ".join(map(repr, names))
    if isinstance(space, gym.spaces.Tuple):
        expected = f"a tuple of {len(names)} {each}s"
    if isinstance(value, np.ndarray) and value.dtype.names:
        return short(list(value.dtype.names)), expected
    return short(list(value) if isinstance(value, Mapping) else value), expected


def repeated(space: gym.Space[Any], goal: Any, n: int) -> Any:
    """Return one goal as a batch of n, of a Dict or Tuple in dicts and tuples; it is not checked.

    A value that is no goal of the space is returned as it is, or repeated, so that the check of
    the batch can show it.
    """
    if isinstance(space, gym.spaces.Dict) and isinstance(goal, Mapping):
        return {k: repeated(space[k], v, n) if k in space.spaces else v for k, v in goal.items()}
    if isinstance(space, gym.spaces.Tuple) and isinstance(goal, tuple | list):
        if len(goal) != len(space.spaces):
            return goal
        return tuple(repeated(part, v, n) for part, v in zip(space.spaces, goal, strict=True))
    try:
        fixed = np.asarray(goal)
    except ValueError:  # of parts of unequal lengths
        return goal
    return np.repeat(fixed[None], n, axis=0)


def part_at(goal: Array, path: tuple[str, ...]) -> Array:
    """Return the part of goals (…) with these names."""
    for name in path:
        goal = goal[name]
    return goal


def leaf_paths(space: gym.Space[Any], before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Return the names that lead to each innermost part of a space; () of one without parts."""
    inner = parts_of(space)
    if inner is None:
        return [before]
    return [path for name, part in inner.items() for path in leaf_paths(part, (*before, name))]


def numbers_in(space: gym.Space[Any]) -> int:
    """Return how many numbers a goal of a space has."""
    one = example_of(space)
    return sum(part_at(one, path).size for path in leaf_paths(space))


def from_numbers(space: gym.Space[Any], numbers: Array) -> Array:
    """Return goals (n, *goal_shape) of a space from their numbers (n, G); see ``Goals.flat``."""
    goals = np.repeat(example_of(space)[None], len(numbers), axis=0)
    first = 0
    for path in leaf_paths(space):
        part = part_at(goals, path)
        size = part[:1].size
        part[...] = numbers[:, first : first + size].reshape(part.shape)
        first += size
    return goals
