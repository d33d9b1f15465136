"""Keys and doors: eight skills learnt in small rooms (``skillweave train keys-and-doors``)."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.pay.suite import Policies, Suite, Task
from skillweave import Hierarchy
from skillweave.recipes import _rooms, keys_and_doors as rooms
from skillweave.types import Array

SOLVED = 0.8


def source(task: Task) -> Hierarchy:
    """Skills, each by itself, then a selector for the small rooms."""
    return rooms.declare(task.name)


def further(task: Task, skills: Policies) -> Hierarchy:
    """Return skills and selector that continue together after the small rooms."""
    return rooms.going_on(task.name)


def cells(obs: Array) -> Array:
    """Return all that is in view, (n, 147)."""
    found: Array = obs.reshape(len(obs), -1)
    return found


def suite() -> Suite:
    """Small rooms, and six tasks of MiniGrid; a score is the share of episodes that do the task."""
    small = Task("small", _rooms.spec("small"), SOLVED)
    targets = [Task(name, _rooms.spec(name), SOLVED, "small") for name in _rooms.TARGETS]
    return Suite(
        name="keys-and-doors",
        tasks=[small, *targets],
        unit=1.0,
        source=source,
        further=further,
        skills=lambda: [skill() for skill in rooms.SKILLS],
        # The skills' network, and it sees the same; the reward is far away.
        flat=replace(rooms.WORKER, num_envs=32, n_steps=128, update_epochs=4, gamma=0.995),
        weights=(
            {s.name: 0.01 for s in rooms.SKILLS[1:]},
            {s.name: 0.05 for s in rooms.SKILLS[1:]},
        ),
        cells=cells,
        bonus=0.01,
        episodes=100,
        greedy=False,
        evaluations=5,
        evaluated=20,
    )
