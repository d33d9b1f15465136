"""Success over the goals of skills, from played calls: a map, or a bar for each goal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.paths import join
from skillweave.calls.log import CallLog
from skillweave.html_report import charts
from skillweave.policies.core import Array
from skillweave.reporting.facts import percent
from skillweave.skills import Skill

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
        of: the origin of the calls, in words.

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
            space = skills[path].goal_space
            goals = every[mine]
            done = log.succeeded[mine]
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
        chosen = goals[:, 0]
        return [
            {"x": str(int(value))} | _counted(done[chosen == value].sum(), (chosen == value).sum())
            for value in np.unique(chosen)
        ], []
    if not isinstance(space, gym.spaces.Box) or goals.shape[1] not in (1, 2):
        return [], []
    count = int(np.clip((len(goals) / CALLS_OF_A_PART) ** (1 / goals.shape[1]), 2, MOST_PARTS))
    edges = [_edges(space, values, i, count) for i, values in enumerate(goals.T)]
    ranges = [[float(edge[0]), float(edge[-1])] for edge in edges]
    inside = np.clip(goals, *np.transpose(ranges))
    calls, won = (np.histogramdd(inside, edges, weights=w)[0] for w in (None, done))
    rows = []
    for place in np.argwhere(calls).tolist():
        row = _counted(won[*place], calls[*place])
        for axis, edge, p in zip("xy", edges, place, strict=False):
            row |= {axis: float(edge[p]), f"{axis}2": float(edge[p + 1])}
        rows.append(row)
    return rows, ranges


def _counted(done: Any, calls: Any) -> dict[str, Any]:
    return {"share": float(done / calls), "calls": int(calls), "done": int(done)}


def _edges(space: gym.spaces.Box, values: Array, i: int, count: int) -> Array:
    """Return the edges of the parts of one number: of its range, or of the goals that there are."""
    low, high = float(space.low.reshape(-1)[i]), float(space.high.reshape(-1)[i])
    low = low if np.isfinite(low) else float(values.min())
    high = high if np.isfinite(high) else float(values.max())
    return np.linspace(low, high if high > low else low + 1.0, count + 1)
