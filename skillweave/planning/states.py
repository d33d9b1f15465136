"""The finite states that a task is planned in: the machine's, with levels of its counters."""

from __future__ import annotations

import itertools

import numpy as np

from skillweave.errors import DeclarationError
from skillweave.planning.machine import RewardMachine
from skillweave.types import Array

LEVELS = 128
"""The most levels of a counter. Between two levels values are interpolated, so that calls which
are shorter than a level also lead on."""
FEWEST_LEVELS = 8
ENOUGH_STATES = 256
"""Counters have fewer levels where there would be more states."""
MOST_STATES = 3_000
MOST_COUNTERS = 4


class PlanningStates:
    """M states for planning: those of a machine, each with all levels of its counters.

    Args:
        task: the machine.

    Raises:
        DeclarationError: there would be more than 3,000, or a state has more than four counters.
    """

    def __init__(self, task: RewardMachine) -> None:
        if task.slots > MOST_COUNTERS:
            raise DeclarationError(
                f"the task waits for {task.slots} events that must hold for several steps at once; "
                f"at most {MOST_COUNTERS} can be planned"
            )
        used = task.counter_steps < np.iinfo(np.int64).max
        most = LEVELS
        while most > FEWEST_LEVELS and _levels(task, most).prod(1).sum() > ENOUGH_STATES:
            most //= 2
        self._levels = _levels(task, most)
        steps = np.where(used, task.counter_steps, 1)
        self._spacing = np.where(used, (steps - 1) / np.maximum(self._levels - 1, 1), 1.0)
        sizes = self._levels.prod(1)
        self._first = np.concatenate([[0], np.cumsum(sizes)])
        self.count = int(self._first[-1])
        """M."""
        if self.count > MOST_STATES:
            raise DeclarationError(
                f"the task has {self.count:,} states with the levels of its counters; at most "
                f"{MOST_STATES:,} can be planned: repeat it less often"
            )
        self.exact = np.zeros((self.count, 1 + task.slots), np.int64)
        """The task's state of each, (M, 1 + H)."""
        self.exact[:, 0] = np.repeat(np.arange(len(sizes)), sizes)
        place = np.arange(self.count) - self._first[self.exact[:, 0]]
        for slot in reversed(range(task.slots)):
            levels = self._levels[self.exact[:, 0], slot]
            spacing = self._spacing[self.exact[:, 0], slot]
            self.exact[:, 1 + slot] = np.round(place % levels * spacing)
            place //= levels

    @property
    def arrays(self) -> dict[str, Array]:
        """The levels of each counter (Q, H), their spacing, and each state's first number (Q,)."""
        return {"levels": self._levels, "spacing": self._spacing, "first": self._first[:-1]}

    def corners(self, state: Array) -> tuple[Array, Array]:
        """Return the planning states around states of the task, and their weights.

        Args:
            state: (…, 1 + H).

        Returns:
            (…, J) int64 and (…, J) float32, J = 2^H; the weights add up to 1.
        """
        q = state[..., 0]
        level = state[..., 1:] / self._spacing[q]
        low = np.clip(np.floor(level), 0, np.maximum(self._levels[q] - 2, 0)).astype(np.int64)
        share = np.clip(level - low, 0.0, 1.0)
        share = np.where(self._levels[q] > 1, share, 0.0)
        places, weights = [], []
        for upper in itertools.product((0, 1), repeat=state.shape[-1] - 1):
            place, weight = np.zeros(q.shape, np.int64), np.ones(q.shape)
            for slot, up in enumerate(upper):
                at = np.minimum(low[..., slot] + up, self._levels[q, slot] - 1)
                place = place * self._levels[q, slot] + at
                weight = weight * (share[..., slot] if up else 1.0 - share[..., slot])
            places.append(self._first[q] + place)
            weights.append(weight)
        return np.stack(places, -1), np.stack(weights, -1).astype(np.float32)

    def place(self, state: Array) -> Array:
        """Return the nearest planning state of each state of the task, (…,) int64."""
        places, weights = self.corners(state)
        nearest = weights.argmax(-1)[..., None]
        return np.take_along_axis(places, nearest, -1)[..., 0]


def _levels(task: RewardMachine, most: int) -> Array:
    """Return the number of levels of each counter, (Q, H); 1 where it is not used."""
    used = task.counter_steps < np.iinfo(np.int64).max
    return np.where(used, np.minimum(task.counter_steps, most), 1)
