"""The declaration of a suite: tasks, skills, budgets, and the baselines' needs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from skillweave import EnvSpec, Hierarchy, Skill, Step
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.types import Array, Policy

Policies = Mapping[str, Policy]
"""The skills that were learnt on the first task, and those by hand, by name."""


@dataclass(frozen=True)
class Task:
    """A task of a suite.

    Args:
        name: letters, digits and dashes: it names files.
        env: its environment, with its own reward.
        solved: a score from here on counts as solved.
        starts_from: an earlier task, by name: the hierarchy begins with what it was at the end of
            that one, its skills too, where they go on learning; F3 with what it was there itself.
            None: F3 begins with the first task.
        alone: whether F0 to F2 have here all that the hierarchy takes for this task alone: what
            learnt its skills, too.
    """

    name: str
    env: EnvSpec
    solved: float
    starts_from: str | None = None
    alone: bool = False


@dataclass(frozen=True)
class Suite:
    """Tasks for the same skills; the first is the one on which skills are learnt.

    Args:
        name: letters, digits and dashes: it names files.
        tasks: in the order in which they are learnt.
        unit: a score is a return divided by this.
        source: the hierarchy that learns the first task, and its skills, from nothing.
        further: the hierarchy that learns another task, given the skills; or without them, where
            they go on learning (``Task.starts_from``).
        skills: those whose rewards are added for F1.
        flat: who learns without skills.
        weights: what F1 chooses from: for each skill a weight of its reward.
        task_weight: what F1 multiplies the task's own reward by.
        cells: observations (n, ...) to whole numbers (n, k): what F2 counts visits of.
        bonus: what a first visit of a cell is worth to F2, in units of the task's reward.
        variants: hierarchies that learn a selector over the same skills in another way, by name.
        fixed: hierarchies in which nothing more is learnt, by name: ready selectors, mostly.
        episodes: how many are played for a score.
        greedy: whether agents act greedily then, or sample.
        evaluations: points of a curve.
        evaluated: episodes of each.
    """

    name: str
    tasks: Sequence[Task]
    unit: float
    source: Callable[[Task], Hierarchy]
    further: Callable[[Task, Policies], Hierarchy]
    skills: Callable[[], Sequence[Skill]]
    flat: AlgorithmConfig
    weights: Sequence[Mapping[str, float]]
    cells: Callable[[Array], Array]
    task_weight: float = 1.0
    bonus: float = 1.0
    variants: Mapping[str, Callable[[Task, Policies], Hierarchy]] = field(default_factory=dict)
    fixed: Mapping[str, Callable[[Task, Policies], Hierarchy]] = field(default_factory=dict)
    episodes: int = 50
    greedy: bool = True
    evaluations: int = 12
    evaluated: int = 10
    scale: float = 1.0
    """All budgets are multiplied by this."""

    def task(self, name: str) -> Task:
        """Return the task of this name."""
        return next(t for t in self.tasks if t.name == name)

    def goes_on(self, task: Task) -> bool:
        """Return whether others need what was learnt on a task."""
        return task is self.tasks[0] or any(t.starts_from == task.name for t in self.tasks)

    def scaled(self, factor: float) -> Suite:
        """Return the suite with other budgets."""
        return replace(self, scale=self.scale * factor)

    def quick(self) -> Suite:
        """Return a two-hundredth of the steps, one episode for each score: to see that all runs."""
        return replace(self.scaled(0.005), episodes=1, evaluations=1, evaluated=1)

    def hierarchy(self, task: Task, skills: Policies | None) -> Hierarchy:
        """Return the hierarchy for a task: without ``skills`` it learns them, too."""
        return self.fitted(self.source(task) if skills is None else self.further(task, skills))

    def fitted(self, found: Hierarchy) -> Hierarchy:
        """Return a hierarchy with the suite's budgets.

        Runs go side by side, so one has several processes only where its recipe says so.
        """
        found.scale(self.scale)
        found.env = replace(found.spec, workers=found.spec.workers or 1)
        return found

    def steps(self) -> list[int]:
        """Return the hierarchy's steps for each task; those of its skills are in the first."""
        first, *others = self.tasks
        ready: Any = {s.name: _no_policy for s in self.source(first).skills}
        further = [self.hierarchy(t, ready).total_steps for t in others]
        return [self.hierarchy(first, None).total_steps, *further]

    def steps_flat(self) -> list[int]:
        """Return a flat agent's steps for each task: the hierarchy's, or more (``alone``)."""
        own = self.steps()
        more = [own[0] if t.alone else 0 for t in self.tasks[1:]]
        return [own[0], *(n + m for n, m in zip(own[1:], more, strict=True))]

    @property
    def headlines(self) -> list[Task]:
        """Return the tasks of F1 and F2: the first one, and those that flat agents learn alone."""
        return [t for t in self.tasks if t is self.tasks[0] or t.alone]


class Shaped(Skill):
    """F1: the task's own reward, and the weighted sum of the skills' rewards."""

    def __init__(
        self, skills: Sequence[Skill], weights: Mapping[str, float], task_weight: float
    ) -> None:
        self.skills, self.weights, self.task_weight = skills, weights, task_weight

    def reward(self, step: Step) -> Array:
        """Return the sum."""
        own = [self.weights[s.name] * s.reward(step) for s in self.skills if s.name in self.weights]
        total: Array = np.sum([self.task_weight * step.reward, *own], axis=0)
        return total


class Seldom(Skill):
    """F2: the task's own reward, and ``size / √n`` for the n-th visit of a cell.

    Bellemare et al. 2016 and Tang et al. 2017 ("#Exploration"): counts of cells in place of states.
    A training that was stopped counts from its start.

    Args:
        cells: observations (n, ...) to whole numbers (n, k).
        size: of the bonus for a first visit, in units of the task's reward.
    """

    reward_changes = True

    def __init__(self, cells: Callable[[Array], Array], size: float) -> None:
        self._cells, self._size = cells, size
        self._counts: Counter[bytes] = Counter()

    def reward(self, step: Step) -> Array:
        """Return the reward with the bonus for the cell that each step leads to."""
        visits = np.empty(len(step.reward))
        for i, cell in enumerate(self._cells(step.next_obs).astype(np.int64)):
            key = cell.tobytes()
            self._counts[key] += 1
            visits[i] = self._counts[key]
        found: Array = step.reward + self._size / np.sqrt(visits)
        return found


def _no_policy(obs: Array) -> Array:
    """Stand in for a learnt skill where only budgets are read."""
    return np.zeros(len(obs))
