"""Success over the goals of skills, from played calls: a map, or a bar for each goal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.paths import join
from skillweave.planning import CallLog
from skillweave.reporting.report import charts
from skillweave.reporting.report.facts import percent
from skillweave.skills import Skill
from skillweave.types import Array

MOST_GOALS = 40
"""The most goals that have a bar each."""
MOST_PARTS = 10
"""The most parts of each number of a goal."""
CALLS_OF_A_PART = 4
"""The calls that a part of the map has, on average, if there are enough."""


def goal_pictures(
    logs: Mapping[str, CallLog], skills: Mapping[str, Skill], of: str
) -> list[dict[str, Any]]:
    """Return a picture for each skill whose goals are one or two numbers, or a choice.

    Args:
        logs: of the levels, by path.
        skills: by path.
        of: where the calls are from, in words.

    Returns:
        Of each: ``name``, ``words``, and ``spec``, its chart.
    """
    found = []
    for level, log in logs.items():
        for name, every in log.goals.items():
            path = join(level, name)
            mine = log.skill == log.number(name)
            if path not in skills or not mine.any():
                continue
            space, goals, done = skills[path].goal_space, every[mine], log.succeeded[mine]
            rows, ranges = _rows(space, goals, done)
            if not rows:
                continue
            draw = charts.goal_map if goals.shape[1] == 2 else charts.goal_bars
            share = f"{int(done.sum()):,} of {len(done):,} calls {of} ({percent(done.mean())})"
            found.append({"name": path, "words": share, "spec": draw(path, rows, ranges)})
    return found


def _rows(
    space: gym.Space[Any] | None, goals: Array, done: Array
) -> tuple[list[dict[str, Any]], list[list[float]]]:
    """Return the parts of a goal space with calls in them, and the range of each number.

    Without parts the space has no picture; without ranges the parts are choices.
    """
    if isinstance(space, gym.spaces.Discrete) and space.n <= MOST_GOALS:
        return [
            {"x": str(int(value))} | _counted(done[goals[:, 0] == value])
            for value in np.unique(goals[:, 0])
        ], []
    if not isinstance(space, gym.spaces.Box) or goals.shape[1] not in (1, 2):
        return [], []
    numbers = goals.shape[1]
    count = int(np.clip((len(goals) / CALLS_OF_A_PART) ** (1 / numbers), 2, MOST_PARTS))
    edges = [_edges(space, goals[:, i], i, count) for i in range(numbers)]
    at = [
        np.clip(np.searchsorted(edge, goals[:, i], side="right") - 1, 0, len(edge) - 2)
        for i, edge in enumerate(edges)
    ]
    rows = []
    for place in sorted(set(zip(*(x.tolist() for x in at), strict=True))):
        inside = np.logical_and.reduce([x == p for x, p in zip(at, place, strict=True)])
        row: dict[str, Any] = _counted(done[inside])
        for axis, edge, p in zip("xy", edges, place, strict=False):
            row |= {axis: float(edge[p]), f"{axis}2": float(edge[p + 1])}
        rows.append(row)
    return rows, [[float(edge[0]), float(edge[-1])] for edge in edges]


def _counted(done: Array) -> dict[str, Any]:
    return {"share": float(done.mean()), "calls": len(done), "done": int(done.sum())}


def _edges(space: gym.spaces.Box, values: Array, i: int, count: int) -> Array:
    """Return the edges of the parts of one number: of its range, or of the goals that there are."""
    low, high = float(space.low.reshape(-1)[i]), float(space.high.reshape(-1)[i])
    low = low if np.isfinite(low) else float(values.min())
    high = high if np.isfinite(high) else float(values.max())
    return np.linspace(low, high if high > low else low + 1.0, count + 1)
