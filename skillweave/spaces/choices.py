"""Choices of a skill with its goal, as a selector makes them, and their numbers.

A choice has a number (a skill, or a skill and a length) and a goal for each skill that has goals;
only the goal of the chosen skill counts. In one array it is ``choice["skill"]`` and
``choice["goal"][name]``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.errors import EnvError
from skillweave.policies.core import Array
from skillweave.policies.hierarchy import SKILL
from skillweave.policies.parts import GOAL
from skillweave.policies.spaces import space_of
from skillweave.spaces.action_codec import ActionCodec, JointCodec, action_codec
from skillweave.spaces.packing import obs_dtype


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

    def rows(self, choice: Array) -> Array:
        """Return choices (n,) as rows (n, …) float64: the number, then all goals."""
        return space_of(self).flat(choice)


@dataclass(frozen=True)
class ChoiceCodec(JointCodec):
    """A converter of choices with goals.

    In policy units a choice is a row of float32: its number, then the goals of all skills, each as
    its own codec has them. Its members are "skill" and each skill that has goals.
    """

    owners: tuple[tuple[int, int], ...] = ()
    """Range of the numbers that choose each skill with goals."""

    @property
    def choices(self) -> int:
        """Return the number of choices."""
        return self.members[0][1].size

    def to_env(self, action: Array) -> Array:
        """Convert policy units (n, size) to choices (n,)."""
        choice = np.zeros(len(action), self.dtype)
        for at, (name, codec) in enumerate(self.members):
            part = choice[GOAL] if at else choice
            part[name] = codec.to_env(self.units(action, at))
        return choice

    def from_env(self, action: Array) -> Array:
        """Convert choices (n,) to policy units (n, size)."""
        found = np.zeros((len(action), self.size), np.float32)
        for at, (name, codec) in enumerate(self.members):
            units = codec.from_env(np.asarray((action[GOAL] if at else action)[name]))
            found[:, self.columns[at]] = units.reshape(len(units), -1)
        return found


def choice_codec(space: ChoiceSpace) -> ChoiceCodec:
    """Return the codec of a selector's choices.

    Raises:
        EnvError: a goal cannot be chosen by a network; the message names the space.
    """
    goals = tuple((name, action_codec(part)) for name, part in space.goal_spaces.items())
    members = ((SKILL, action_codec(space[SKILL])), *goals)
    owners = tuple(space.owners[name] for name in space.goal_spaces)
    return ChoiceCodec(space, (), members=members, owners=owners)


MOST = 10_000
"""The most skills with goals, each a number, that a selector with values chooses from."""


@dataclass(frozen=True)
class NumberedChoiceCodec(ActionCodec):
    """A converter of choices whose goals are discrete: each skill with each goal has a number."""

    goals: tuple[tuple[str, ActionCodec, tuple[int, int]], ...] = ()
    """Name, codec of goals and range of numbers of each skill with goals."""

    @cached_property
    def table(self) -> Array:
        """Return the choice of each number, (size,)."""
        space = self.space
        assert isinstance(space, ChoiceSpace)
        rows = []
        for number in range(space.choices):
            own = [x for x in self.goals if x[2][0] <= number < x[2][1]]
            goals = _all_goals(own[0][1]) if own else [None]
            for goal in goals:
                choice = np.zeros((), obs_dtype(space))
                choice[SKILL] = number
                for name, codec, _ in self.goals:
                    first = _all_goals(codec)[0]
                    mine = own and own[0][0] == name
                    choice[GOAL][name] = goal if mine else first
                rows.append(choice)
        return np.stack(rows)

    @cached_property
    def number_of_choice(self) -> Array:
        """Return the choice without goal that each number has, (size,) int64: of masks."""
        found: Array = self.table[SKILL]
        return found

    def to_env(self, action: Array) -> Array:
        """Convert numbers (n,) to choices (n,)."""
        found: Array = self.table[action]
        return found

    def from_env(self, action: Array) -> Array:
        """Convert choices (n,) to numbers (n,) int64."""
        keys = {self._key(choice): i for i, choice in enumerate(self.table)}
        return np.array([keys[self._key(choice)] for choice in action], np.int64)

    def _key(self, choice: Any) -> tuple[Any, ...]:
        number = int(choice[SKILL])
        goals = [choice[GOAL][name] for name, _, (a, b) in self.goals if a <= number < b]
        return (number, *(np.asarray(goal).tobytes() for goal in goals))


def _all_goals(codec: ActionCodec) -> list[Array]:
    """Return all goals of a discrete space."""
    units = np.indices(codec.parts).reshape(len(codec.parts), -1).T
    return list(codec.to_env(units if codec.multi else units[:, 0]))


def numbered_choice_codec(space: ChoiceSpace) -> NumberedChoiceCodec:
    """Return the codec of a selector's choices as numbers, where all goals are discrete.

    Raises:
        EnvError: there are too many; the message says how many.
    """
    goals = tuple(
        (name, action_codec(part), space.owners[name]) for name, part in space.goal_spaces.items()
    )
    size = space.choices
    for _, codec, (first, last) in goals:
        size += (last - first) * (math.prod(codec.parts) - 1)
    if size > MOST:
        raise EnvError(
            f"the selector would choose among {size:,} skills with goals, but one with values "
            f"takes at most {MOST:,}: let it learn by PPO, or give goal_space fewer goals"
        )
    return NumberedChoiceCodec(space, (size,), goals=goals)


def chosen(choice: Tensor, owner: tuple[int, int]) -> Tensor:
    """Return where the numbers ``choice`` (…) are of a skill, (…) bool."""
    return (choice >= owner[0]) & (choice < owner[1])
