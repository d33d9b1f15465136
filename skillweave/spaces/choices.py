"""Choices of a skill with its goal, as a selector makes them, and their numbers.

A choice has a number (a skill, or a skill and a length) and a goal for each skill that has goals;
only the goal of the chosen skill counts. In one array it is ``choice["skill"]`` and
``choice["goal"][name]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.spaces.action_codec import ActionCodec, action_codec
from skillweave.spaces.packing import obs_dtype
from skillweave.types import Array

SKILL, GOAL = "skill", "goal"
"""The parts of a choice."""


class ChoiceSpace(gym.spaces.Dict):
    """The space of a selector's choices where skills have goals.

    Args:
        choices: the number of skills, times lengths where these are chosen, too.
        goal_spaces: of the skills that have goals, by their names.
        owners: the numbers that each of these skills has, from the first to before the last.
    """

    def __init__(
        self,
        choices: int,
        goal_spaces: Mapping[str, gym.Space[Any]],
        owners: Mapping[str, tuple[int, int]],
    ) -> None:
        goals = gym.spaces.Dict(list(goal_spaces.items()))
        super().__init__([(SKILL, gym.spaces.Discrete(choices)), (GOAL, goals)])
        self.choices = choices
        self.goal_spaces = dict(goal_spaces)
        self.owners = dict(owners)


@dataclass(frozen=True)
class ChoiceCodec(ActionCodec):
    """A converter of choices with goals.

    In policy units a choice is a row of float32: its number, then the goals of all skills, each as
    an ``ActionCodec`` has them.
    """

    goals: tuple[tuple[str, ActionCodec, tuple[int, int]], ...] = ()
    """Of each skill with goals: its name, their codec, and the numbers that choose it."""

    @property
    def choices(self) -> int:
        """Return the number of choices."""
        space = self.space
        assert isinstance(space, ChoiceSpace)
        return space.choices

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Return the columns of each skill's goal in policy units."""
        found, start = [], 1
        for _, codec, _ in self.goals:
            width = max(1, len(codec.parts)) if codec.discrete else codec.size
            found.append(slice(start, start + width))
            start += width
        return tuple(found)

    @cached_property
    def size(self) -> int:
        """Return the numbers of a choice in policy units."""
        return self.columns[-1].stop

    def units(self, action: Any, at: int) -> Any:
        """Return the goals ``at`` of choices (…, size) as their own codec has them."""
        codec, part = self.goals[at][1], action[..., self.columns[at]]
        if not codec.discrete:
            return part
        part = part.long() if isinstance(part, Tensor) else part.astype(np.int64)
        return part if codec.multi else part[..., 0]

    def to_env(self, action: Array) -> Array:
        """Convert policy units (n, size) to choices (n,)."""
        choice = np.zeros(len(action), obs_dtype(self.space))
        choice[SKILL] = action[:, 0].astype(np.int64)
        for at, (name, codec, _) in enumerate(self.goals):
            choice[GOAL][name] = codec.to_env(self.units(action, at))
        return choice

    def from_env(self, action: Array) -> Array:
        """Convert choices (n,) to policy units (n, size)."""
        found = np.zeros((len(action), self.size), np.float32)
        found[:, 0] = action[SKILL]
        for at, (name, codec, _) in enumerate(self.goals):
            units = codec.from_env(np.asarray(action[GOAL][name]))
            found[:, self.columns[at]] = units.reshape(len(units), -1)
        return found

    def check(self, action: Tensor) -> None:
        """Raise a ValueError where choices in policy units (…, size) do not exist."""
        if not bool(action.isfinite().all()):
            raise ValueError("a choice of its rows is not finite")
        number = action[..., 0]
        if not bool(((number >= 0) & (number < self.choices) & (number == number.trunc())).all()):
            raise ValueError("a choice of its rows does not exist")
        for at, (_, codec, _) in enumerate(self.goals):
            codec.check(self.units(action, at))


def choice_codec(space: ChoiceSpace) -> ChoiceCodec:
    """Return the codec of a selector's choices.

    Raises:
        EnvError: a goal cannot be chosen by a network; the message names the space.
    """
    goals = tuple(
        (name, action_codec(part), space.owners[name]) for name, part in space.goal_spaces.items()
    )
    return ChoiceCodec(space, (), goals=goals)


def chosen(choice: Tensor, owner: tuple[int, int]) -> Tensor:
    """Return where the numbers ``choice`` (…) are of a skill, (…) bool."""
    return (choice >= owner[0]) & (choice < owner[1])


__all__ = ["GOAL", "SKILL", "ChoiceCodec", "ChoiceSpace", "choice_codec", "chosen"]
