"""Errors of unsupported action spaces, with wrappers that make supported ones of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave.errors import EnvError
from skillweave.policies.spaces import MOST_CHOICES, MOST_OF_ALL
from skillweave.spaces.packing import parts

ACTIONS = "Discrete, MultiDiscrete, MultiBinary, Box, and Dict and Tuple of these"


def named_action(space: gym.Space[Any], place: str) -> str:
    """Return the name of an action space, or of its part at ``place``, for messages."""
    shown = " ".join(short(space, 200).split())
    return f"the part {place} of the action space, {shown}," if place else f"action space {shown}"


def unsupported_action(space: gym.Space[Any], place: str = "") -> EnvError:
    """Return the error for an action space that is not supported; it shows a wrapper.

    Args:
        place: the names that lead to it, with dots, where it is a part of a Dict or Tuple.
    """
    what, function = "Let a function make its actions", "gymnasium.spaces.Box(...)"
    supported = ACTIONS
    if all(isinstance(leaf, gym.spaces.Box) for leaf in _leaves(space)):
        supported += (
            f"; whole numbers of a Box need bounds and at most {MOST_CHOICES} values each, "
            f"{MOST_OF_ALL:,} in all"
        )
        what, function = (
            "Let a function round real numbers to it",
            "gymnasium.spaces.Box(-1.0, 1.0, ...)",
        )
    return EnvError(
        f"{named_action(space, place)} is not supported; supported are: {supported}. {what}: "
        "EnvSpec(env, wrappers=(lambda env: gymnasium.wrappers.TransformAction(env, function, "
        f"{function}),))"
    )


def _leaves(space: gym.Space[Any]) -> Iterator[gym.Space[Any]]:
    if not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        yield space
        return
    for part in (parts(space) or {}).values():
        yield from _leaves(part)


def values_of(space: gym.spaces.Box) -> np.ndarray[Any, Any] | None:
    """Return how many values each whole number of a Box has, (A,) int64; None: too many."""
    low, high = (x.reshape(-1).tolist() for x in (space.low, space.high))
    counts = [int(b) - int(a) + 1 for a, b in zip(low, high, strict=True)]  # Python's: no overflow
    if max(counts, default=0) > MOST_CHOICES or sum(counts) > MOST_OF_ALL:
        return None
    return np.array(counts, np.int64)
