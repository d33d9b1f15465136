"""Mazes: a ball finds its goal, with skills that serve every maze (``skillweave train mazes``)."""

from __future__ import annotations

import numpy as np

from benchmarks.pay.suite import Policies, Suite, Task
from skillweave import Hierarchy
from skillweave.recipes import _mazes, mazes
from skillweave.types import Array

SOLVED = 0.9
STARTS = {
    "large-diverse": "large",
    "medium-diverse": "large",
    "medium": "medium-diverse",
    "umaze": "medium",
}
"""By maze, the one whose selector its own starts from. Diverse mazes have the same walls."""


def source(task: Task) -> Hierarchy:
    """Skills, each by itself, then a selector."""
    return mazes.declare(task.name)


def further(task: Task, skills: Policies) -> Hierarchy:
    """Return a selector over skills that are there already."""
    return mazes.with_skills(task.name, skills)


def shortest_path(task: Task, skills: Policies) -> Hierarchy:
    """Return the skills under the maze's shortest path: an upper bound for a result."""
    chooses = _mazes.ShortestPath(task.name)
    return mazes.with_skills(task.name, skills, selector=chooses, call_steps=10)


def cells(obs: Array) -> Array:
    """Return where the ball is, and where the goal, in metres, (n, 4)."""
    return np.floor(obs[:, [0, 1, 4, 5]])


def suite() -> Suite:
    """Five mazes; a score is the share of episodes that reach the goal."""
    return Suite(
        name="mazes",
        tasks=[Task(name, _mazes.spec(name), SOLVED, STARTS.get(name)) for name in _mazes.MAZES],
        unit=1.0,
        source=source,
        further=further,
        skills=lambda: [skill() for skill in mazes.SKILLS],
        flat=mazes.FLAT,
        weights=(
            {"approach": 0.001},
            {s.name: 0.001 for s in mazes.SKILLS},
        ),
        cells=cells,
        bonus=0.01,
        fixed={"shortest-path": shortest_path},
        episodes=60,
        greedy=False,
        evaluations=5,
        evaluated=20,
    )
