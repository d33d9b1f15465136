"""The finite states that a task is planned in: the machine's, with levels of its counters."""

from __future__ import annotations

import numpy as np

from skillweave.errors import DeclarationError
from skillweave.planning.machine import RewardMachine
from skillweave.policies.plan import MOST_COUNTERS, Levels
from skillweave.types import Array

LEVELS = 128
"""The most levels of a counter."""
FEWEST_LEVELS = 8
ENOUGH_STATES = 256
"""Counters have fewer levels where there would be more states."""
MOST_STATES = 3_000


def planning_states(task: RewardMachine) -> Levels:
    """Return M states for planning: those of a machine, each with all levels of its counters.

    Raises:
        DeclarationError: there would be more than 3,000, or a state has more than four counters.
    """
    if task.slots > MOST_COUNTERS:
        raise DeclarationError(
            f"the task waits for {task.slots} events that must hold for several steps at once; "
            f"at most {MOST_COUNTERS} can be planned"
        )
    used = task.counter_steps < np.iinfo(np.int64).max
    most = LEVELS
    while most > FEWEST_LEVELS and _levels(task, most).prod(1).sum() > ENOUGH_STATES:
        most //= 2
    levels, steps = _levels(task, most), np.where(used, task.counter_steps, 1)
    spacing = np.where(used, (steps - 1) / np.maximum(levels - 1, 1), 1.0)
    sizes = levels.prod(1)
    states = Levels(levels, spacing, np.cumsum(sizes) - sizes)
    if states.count > MOST_STATES:
        raise DeclarationError(
            f"the task has {states.count:,} states with the levels of its counters; at most "
            f"{MOST_STATES:,} can be planned: repeat it less often"
        )
    return states


def exact_states(states: Levels) -> Array:
    """Return the task's state that each planning state is, (M, 1 + H)."""
    q = np.repeat(np.arange(len(states.first)), states.levels.prod(1))
    place = np.arange(states.count) - states.first[q]
    exact = np.zeros((states.count, 1 + states.levels.shape[1]), np.int64)
    exact[:, 0] = q
    for slot in reversed(range(states.levels.shape[1])):
        count = states.levels[q, slot]
        exact[:, 1 + slot] = np.round(place % count * states.spacing[q, slot])
        place //= count
    return exact


def _levels(task: RewardMachine, most: int) -> Array:
    """Return the number of levels of each counter, (Q, H); 1 where it is not used."""
    used = task.counter_steps < np.iinfo(np.int64).max
    return np.where(used, np.minimum(task.counter_steps, most), 1)
