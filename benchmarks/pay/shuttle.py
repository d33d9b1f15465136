"""Shuttle: a half-cheetah runs between points (``skillweave train shuttle``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.grouped import regroup
from benchmarks.pay.suite import Policies, Suite, Task
from skillweave import Hierarchy
from skillweave.recipes import _cheetah as cheetah, shuttle
from skillweave.types import Array

POINTS = {
    "shuttle-2": (2.0, -2.0),
    "shuttle-4": (4.0, -4.0),
    "patrol-forth": (2.0, 6.0, -2.0),
    "patrol-back": (-4.0, 0.0, 4.0),
}
BEST, ROUND = 8.31, 8.0
"""The paper's best median after 3M steps, and the metres of a round there."""
FURTHER_STEPS = 300_000


def bar(points: tuple[float, ...]) -> float:
    """Return the bar of a solved task: the paper's best, for the same metres a second."""
    metres = float(np.abs(np.subtract(points, np.roll(points, 1))).sum())
    return BEST * ROUND / metres


def source(task: Task) -> Hierarchy:
    """Return the first task: skills and selector learn together, from nothing."""
    return shuttle.declare(POINTS[task.name])


def further(task: Task, skills: Policies) -> Hierarchy:
    """Return a selector over skills that are there already."""
    found = shuttle.with_skills(POINTS[task.name], skills)
    regroup(found, selector_steps=FURTHER_STEPS)
    return found


def by_automaton(task: Task, skills: Policies) -> Hierarchy:
    """Return the skills under the task's own automaton: an upper bound for a result."""
    return shuttle.by_automaton(POINTS[task.name], skills)


def cells(obs: Array) -> Array:
    """Return metres from the point, speed in 2 metres a second, and the leg, (n, 3)."""
    leg = obs[:, cheetah.LEG].argmax(axis=1)
    x = cheetah.from_log(obs[:, cheetah.X])
    return np.stack([np.floor(x), np.floor(obs[:, cheetah.SPEED] / 2.0), leg], 1)


def suite() -> Suite:
    """Four tasks."""
    return Suite(
        name="shuttle",
        tasks=[Task(name, cheetah.spec(p), bar(p)) for name, p in POINTS.items()],
        unit=shuttle.UNIT,
        source=source,
        further=further,
        skills=lambda: shuttle.declare().skills,
        flat=replace(shuttle.RUNNER, gamma=0.99, gae_lambda=0.95, network=shuttle.RELU),
        weights=(
            {"forward": 1.0, "backward": 1.0},
            {"forward": 1.0, "backward": 0.5},
            {"forward": 0.5, "backward": 1.0},
        ),
        cells=cells,
        bonus=10.0,
        fixed={"automaton": by_automaton},
        episodes=20,
    )
