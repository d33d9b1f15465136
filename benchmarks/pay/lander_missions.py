"""Lander missions: four skills for all missions (``skillweave train lander-missions``)."""

from __future__ import annotations

import numpy as np

from benchmarks.pay.suite import Policies, Suite, Task
from skillweave import Hierarchy
from skillweave.recipes import lander_missions as missions
from skillweave.types import Array

TASKS = {
    "any": ("any", False),
    "tour": ("tour", False),
    "hover": ("hover", False),
    "land": ("land", False),
    "gusts": ("tour", True),
}
"""By task, the mission, and whether there are gusts."""
SOLVED = 0.9


def source(task: Task) -> Hierarchy:
    """Skills, each by itself, then a selector for all missions."""
    return missions.declare(*TASKS[task.name])


def further(task: Task, skills: Policies) -> Hierarchy:
    """Return a selector for one mission, over skills that are there already."""
    mission, gusts = TASKS[task.name]
    return missions.with_skills(mission, skills, gusts)


def by_leg(task: Task, skills: Policies) -> Hierarchy:
    """Return the skills under the rule by leg: an upper bound for a result."""
    mission, gusts = TASKS[task.name]
    return missions.with_skills(mission, skills, gusts, selector=missions.by_leg)


def cells(obs: Array) -> Array:
    """Return place, speed, and the legs still to be done, (n, 16)."""
    return np.concatenate([np.floor(obs[:, :4] / 0.2), obs[:, missions.TO_DO]], axis=1)


def suite() -> Suite:
    """Five tasks; a score is the share of legs that are done."""
    one = missions.environment
    return Suite(
        name="lander-missions",
        tasks=[
            Task(name, one(*found), SOLVED, alone=name == "tour") for name, found in TASKS.items()
        ],
        unit=1.0,
        source=source,
        further=further,
        skills=lambda: [skill() for skill in missions.SKILLS],
        flat=missions.FLAT,
        weights=(
            {s.name: 0.001 for s in missions.SKILLS},
            {"land": 0.003, "hover": 0.001, "go_left": 0.001, "go_right": 0.001},
        ),
        cells=cells,
        bonus=0.01,
        fixed={"by-leg": by_leg},
        evaluations=8,
    )
