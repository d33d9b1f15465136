"""Pick and place: scripted skills, and one that is learnt (``skillweave train pick-and-place``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.grouped import regroup
from benchmarks.pay.suite import Policies, Suite, Task
from skillweave import Hierarchy
from skillweave.recipes import _arm as world, pick_and_place as arm
from skillweave.types import Array

DISTURBANCES = {"calm": world.CALM, "disturbed": world.Disturbances()}
SOLVED = {"calm": 0.95, "disturbed": 0.85}
FURTHER_STEPS = 30_000


def source(task: Task) -> Hierarchy:
    """Return the first task, on which one skill and the selector learn."""
    return arm.declare(DISTURBANCES[task.name])


def further(task: Task, skills: Policies) -> Hierarchy:
    """Return a new selector over the same skills."""
    return with_skills(arm.declare, task, skills)


def anchored(task: Task, skills: Policies) -> Hierarchy:
    """Return a new selector that is kept near the behaviour tree while it learns."""
    return with_skills(arm.anchored, task, skills)


def with_skills(declare: Callable[..., Hierarchy], task: Task, skills: Policies) -> Hierarchy:
    """Return a hierarchy with the learnt skill."""
    found = declare(DISTURBANCES[task.name])
    regroup(found, selector_steps=FURTHER_STEPS)
    found.skill("recover").policy = skills["recover"]
    return found


def by_hand(selector: Any, call_steps: int = 1) -> Any:
    """Return a hierarchy in which nothing is learnt."""

    def declare(task: Task, skills: Policies) -> Hierarchy:
        return arm.by_hand(selector, DISTURBANCES[task.name], call_steps)

    return declare


def cells(obs: Array) -> Array:
    """Return the block's place from the gripper, its height, and if it is grasped, (n, 5)."""
    places = np.column_stack([obs[:, arm.OFFSET], obs[:, arm.BLOCK][:, 2]])
    return np.column_stack([np.floor(places / 0.04), world.is_held(obs)])


def suite() -> Suite:
    """Two tasks: nothing goes wrong, and something does."""
    return Suite(
        name="pick-and-place",
        tasks=[Task(name, world.spec(d), SOLVED[name]) for name, d in DISTURBANCES.items()],
        unit=1.0,
        source=source,
        further=further,
        skills=lambda: [arm.Recover()],
        flat=arm.LEARNER,
        weights=({"recover": 0.1}, {"recover": 0.01}),
        cells=cells,
        bonus=0.1,
        variants={"tree-anchored": anchored},
        fixed={
            "rule": by_hand(arm.rule),
            "script": by_hand(arm.script),
            "tree": by_hand(arm.behaviour_tree),
        },
        episodes=100,
    )
