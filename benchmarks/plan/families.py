"""The families of tasks of ``python -m benchmarks.plan``, and how each is planned.

The settings of each family were chosen on other logs than those that are measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.pay import shuttle as shuttle_suite
from examples import bridge
from skillweave import Apart, EnvSpec, Hierarchy, Step
from skillweave.calls import held
from skillweave.planning import GoalTask, Mission
from skillweave.recipes import _cheetah, _mazes, _missions, lander_missions, mazes, shuttle
from skillweave.types import Array, Evaluation

Policies = Mapping[str, Any]
"""Skills by name."""


@dataclass(frozen=True)
class NewTask:
    """A task that is planned.

    Args:
        name: letters, digits and dashes: it names files.
        env: the environment, which scores the task by its own reward.
        task: what the planner plans; its predicates see what the environment's reward goes by.
        steps: logged steps.
        log: the name of the log; tasks with the same one share it.
        logged_in: where calls are logged; None: in ``env``.
        explored: whether an ``Explorer`` chooses the calls, or they are random.
    """

    name: str
    env: EnvSpec
    task: Any
    steps: int
    log: str
    logged_in: EnvSpec | None = None
    explored: bool = False


@dataclass(frozen=True)
class Family:
    """Tasks for the same skills.

    Args:
        name: letters, digits and dashes: it names files.
        tasks: in the order of the table.
        source: the hierarchy whose training gives the skills.
        over: the hierarchy on a task over skills that are there; further arguments are settings.
        by_hand: the selector by hand for a task; of none the first skill is called, which only
            makes a run.
        planner: settings of ``Run.plan``.
        score: a number for an evaluation; the higher the better.
        shipped: the recipe whose shipped weights are those of seed 0; None: seed 0 is trained.
        selector_steps: of a selector that is trained as its recipe does; None: the family has none.
        explorer: settings of ``Explorer``.
        greedy: whether a selector that learnt acts greedily.
        good: a score from here on counts as good.
    """

    name: str
    tasks: Sequence[NewTask]
    source: Callable[[], Hierarchy]
    over: Callable[..., Hierarchy]
    planner: Mapping[str, Any]
    score: Callable[[Evaluation], float]
    by_hand: Callable[[NewTask], Any] | None = None
    shipped: str | None = None
    selector_steps: int | None = None
    explorer: Mapping[str, Any] = field(default_factory=dict)
    greedy: bool = True
    good: float = 0.9

    def task(self, name: str) -> NewTask:
        """Return the task of this name."""
        return next(t for t in self.tasks if t.name == name)


def share_done(found: Evaluation) -> float:
    """Return the share of episodes that earned all there is, 1."""
    return float(np.mean(np.array(found.returns) > 0.99))


def only_first(source: Hierarchy) -> Hierarchy:
    """Return a hierarchy whose skills learn, and whose selector calls the first one, always."""
    name = source.skills[0].name
    source.selector = lambda obs: [name] * len(obs)
    return source


# Lander: six orders of three legs.

ORDERS = (
    ("left", "right", "hover"),
    ("right", "left", "hover"),
    ("hover", "left", "right"),
    ("right", "hover", "left"),
    ("left", "right", "left"),
    ("hover", "right", "left"),
)
"""Missions that no training saw."""


def in_box(kind: str) -> Callable[[Array], Array]:
    """Return the predicate that the lander is in the box of a kind of leg."""
    i = _missions.KINDS.index(kind)

    def inside(obs: Array) -> Array:
        off = np.abs(obs[:, :2] - _missions.POINTS[i])
        within: Array = (off <= _missions.HALF[i] + 1e-6).all(axis=1)
        return within

    inside.__name__ = kind
    return inside


LEGS = {
    "left": in_box("left"),
    "right": in_box("right"),
    "hover": held(in_box("hover"), _missions.HOVER_STEPS),
}
"""The events that do a leg."""


def _order(legs: tuple[str, ...]) -> NewTask:
    return NewTask(
        "-".join(legs),
        _missions.spec("-".join(legs), [legs]),
        Mission(*(LEGS[leg] for leg in legs)),
        steps=40_000,
        log="any",
        logged_in=lander_missions.environment("any"),
    )


def _lander_over(task: NewTask, skills: Policies, **how: Any) -> Hierarchy:
    found = lander_missions.with_skills("any", skills, **how)
    found.env = task.env
    return found


def lander() -> Family:
    """Six orders of legs, from 40,000 logged steps."""
    return Family(
        name="lander",
        tasks=[_order(legs) for legs in ORDERS],
        source=lambda: lander_missions.declare("any", selector=lander_missions.by_leg),
        over=_lander_over,
        planner={},
        score=share_done,
        by_hand=lambda task: lander_missions.by_leg,
        shipped="lander-missions",
        selector_steps=300_000,
    )


# Mazes: any goal in a maze.


def at_goal(obs: Array, goal: Array) -> Array:
    """Return whether the ball is at its goal, (n,) bool."""
    near: Array = np.hypot(*(obs[:, _mazes.PLACE] - goal).T) <= _mazes.REACH
    return near


def _maze(name: str, steps: int, explored: bool = False) -> NewTask:
    task = GoalTask(at_goal, columns=(4, 5))
    return NewTask(name, _mazes.spec(name), task, steps, name, explored=explored)


def _maze_over(task: NewTask, skills: Policies, **how: Any) -> Hierarchy:
    return mazes.with_skills(task.name, skills, **how)


PLACE = (0, 1)
"""What makes two calls alike."""


def maze() -> Family:
    """Four mazes, with skills that were learnt in the large one."""
    return Family(
        name="mazes",
        tasks=[
            _maze("medium", 20_000),
            _maze("large", 50_000),
            _maze("medium-diverse", 50_000, explored=True),
            _maze("large-diverse", 50_000, explored=True),
        ],
        source=lambda: only_first(mazes.declare("large")),
        over=_maze_over,
        planner={"gamma": 0.997, "features": PLACE},
        score=share_done,
        by_hand=lambda task: _mazes.ShortestPath(task.name),
        shipped="mazes",
        selector_steps=200_000,
        explorer={"features": PLACE, "radius": 0.25},
        greedy=False,
    )


# Shuttle: other points than those of the training.


def own_reward(step: Step) -> Array:
    """Return the environment's own reward, (n,)."""
    return step.reward


def _patrol(name: str) -> NewTask:
    env = _cheetah.spec(shuttle_suite.POINTS[name])
    return NewTask(name, env, own_reward, 100_000, name)


def _shuttle_over(task: NewTask, skills: Policies, **how: Any) -> Hierarchy:
    settings = {"apart": Apart(selector_steps=shuttle_suite.FURTHER_STEPS)} | how
    return shuttle.with_skills(shuttle_suite.POINTS[task.name], skills, **settings)


def patrols() -> Family:
    """Three patrols of a half-cheetah, with the skills of the first."""
    names = [name for name in shuttle_suite.POINTS if name != "shuttle-2"]
    return Family(
        name="shuttle",
        tasks=[_patrol(name) for name in names],
        source=shuttle.declare,
        over=_shuttle_over,
        planner={},
        score=lambda found: found.mean / shuttle.UNIT,
        shipped="shuttle",
        selector_steps=shuttle_suite.FURTHER_STEPS,
        good=shuttle_suite.BEST * 0.9,
    )


# Bridge: a chain of four skills.


def _bridge_over(task: NewTask, skills: Policies, **how: Any) -> Hierarchy:
    settings = {"learn": "apart", "apart": Apart(selector_steps=200_000)} | how
    nothing_together: Any = None
    found = bridge.declare(nothing_together, workers=1, **settings)
    for skill in found.skills:
        skill.policy = skills[skill.name]
    return found


def chain() -> Family:
    """The bridge, with the skills of a hierarchy that learnt together."""
    env = EnvSpec(bridge.River, workers=1)
    return Family(
        name="bridge",
        tasks=[NewTask("bridge", env, own_reward, 100_000, "bridge")],
        source=lambda: replace(bridge.declare(), env=env),
        over=_bridge_over,
        planner={"gamma": 0.97},
        score=share_done,
        selector_steps=200_000,
    )


FAMILIES: dict[str, Callable[[], Family]] = {
    "lander": lander,
    "mazes": maze,
    "shuttle": patrols,
    "bridge": chain,
}
