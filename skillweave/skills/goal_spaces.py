"""Spaces with goals: what a skill with goals observes, and elements of a space of goals.

Importing it needs no torch, so that skills can be declared without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave.policies.core import Array
from skillweave.policies.hierarchy import SKILL
from skillweave.policies.parts import GOAL, OBSERVATION
from skillweave.policies.spaces import Space as Data, at, space_of


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


def other_goals(trained: gym.Space[Any], declared: gym.Space[Any]) -> str:
    """Return the end of a message about a skill that was trained for other goals; "": the same.

    Other bounds are other goals: they say which goals it practised.
    """
    from skillweave.spaces.saving import gym_space  # needs torch, which declaring does not

    # MultiBinary([4]) is MultiBinary(4) where it was read from a file.
    one, other = (gym_space(space_of(space)) for space in (trained, declared))
    if one == other:
        return ""
    return (
        f"was trained for goals of {short(trained, 300)}, but now its goal_space is "
        f"{short(declared, 300)}: declare goal_space as it was, or train again"
    )


def choice_space(
    choices: int, goal_spaces: Mapping[str, gym.Space[Any]], skills: Sequence[str]
) -> gym.Space[Any]:
    """Return the space of the choices among declared skills: numbers, or numbers and goals.

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


def blank_choices(space: gym.Space[Any], number: Array) -> Array:
    """Return choices of a ``choice_space`` with these numbers (k,), and some goals, to be set."""
    if isinstance(space, gym.spaces.Discrete):
        return number
    choice = space_of(space).start(len(number))
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
    """Draw n goals, or elements of another space, as one batch: uniformly where it is bounded."""
    whole = space_of(space)
    batch = whole.start(n)
    for path, leaf in whole.leaves.items():
        (low, high) = leaf.bounds
        shape = (n, *leaf.shape)
        if np.dtype(leaf.dtype).kind in "iub":
            ends = low.astype(np.int64), high.astype(np.int64)
            at(batch, path)[...] = rng.integers(*ends, size=shape, endpoint=True)
            continue
        least, most = low.astype(np.float64), high.astype(np.float64)
        below, above = np.isfinite(least), np.isfinite(most)
        drawn = rng.standard_normal(shape)
        tail = np.abs(drawn)
        drawn = np.where(below & ~above, least + tail, np.where(above & ~below, most - tail, drawn))
        if (both := below & above).any():
            with np.errstate(invalid="ignore", over="ignore"):
                uniform = least + rng.random(shape) * (most - least)
            drawn = np.where(both, uniform, drawn)
        at(batch, path)[...] = drawn.astype(leaf.dtype).clip(low, high)
    return batch


def alone(space: Data, goal: Any) -> Any:
    """Return one goal, or element of a space, as a batch of one; it is not checked.

    A value that is no element is returned as it is, or as a batch, so that the check of the batch
    can show it.
    """
    parts = space.parts or {}
    if parts and (given := space.by_name(goal)) is not None:
        return {k: alone(parts[k], v) if k in parts else v for k, v in given.items()}
    try:
        return np.asarray(goal)[None]
    except ValueError:  # of parts of unequal lengths
        return goal
