"""Learning curves: the metrics of each agent in ``metrics.jsonl``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from skillweave.runs.directory import RunDirectory
from skillweave.training.episodes import INFO

MOST_POINTS = 300
TOLD_BY_ALL = ("stage", "update", "steps", "seconds")
FIRST = ("return", "eval_return", "eval_success", "task_return", "length", "success", "fitness")
"""Metrics that are offered first, in this order."""


@dataclass
class Curves:
    """One agent's metrics in one stage."""

    stage: str
    agent: str
    """The stage's name, or of those that learn together, one of them."""
    points: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    """By metric: environment steps of the stage, and the value."""

    @property
    def label(self) -> str:
        """Return its name for people."""
        return self.stage if self.agent == self.stage else f"{self.agent} in {self.stage}"


def read_curves(run: RunDirectory) -> list[Curves]:
    """Return the curves of every agent, in the order of the schedule.

    Stages without metrics have none.

    Raises:
        RunError: the file is damaged.
    """
    curves_of: dict[tuple[str, str], Curves] = {}
    stages = {entry.name: entry for entry in run.manifest.stages}
    for line in run.metrics():
        stage = str(line.get("stage"))
        if stage not in stages or "steps" not in line:
            continue
        for key, value in line.items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if key in TOLD_BY_ALL or not number or not math.isfinite(value):
                continue
            # A key of info may have a dot of its own.
            agent, dot, metric = ("", "", key) if key.startswith(INFO) else key.rpartition(".")
            agent = agent if dot else stage
            curves = curves_of.setdefault((stage, agent), Curves(stage, agent))
            curves.points.setdefault(metric, []).append((int(line["steps"]), float(value)))
    order = list(stages)
    return sorted(
        curves_of.values(), key=lambda c: (order.index(c.stage), c.agent != c.stage, c.agent)
    )


def reached_steps(all_curves: Sequence[Curves]) -> dict[str, int]:
    """Return by stage the steps of the last line of its metrics."""
    return {
        c.stage: max(points[-1][0] for points in c.points.values()) for c in all_curves if c.points
    }


def metrics_of(all_curves: list[Curves]) -> list[str]:
    """Return the names of all metrics, the most important ones first."""
    names = {name for curves in all_curves for name in curves.points}
    return sorted(names, key=lambda n: (FIRST.index(n) if n in FIRST else len(FIRST), n))


def thinned(points: list[Any], most: int = MOST_POINTS) -> list[Any]:
    """Return at most about ``most`` of the points, evenly spaced, with the last one."""
    every = -(-len(points) // most)
    return points[::-1][::every][::-1] if every > 1 else points
