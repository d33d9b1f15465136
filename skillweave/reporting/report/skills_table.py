"""Rows for the page's tables: the figures of each skill, and the transitions between skills."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

from skillweave.reporting.report.numbers import number, percent, scale_of
from skillweave.skills import Skill
from skillweave.training.skill_report import SkillReport, all_steps

WHY = {
    "own": "by itself",
    "limit": "at a limit",
    "interrupted": "cut by the selector",
    "episode": "with the episode",
}
"""Ends of calls in the page's words."""


def skill_rows(reports: Mapping[str, SkillReport]) -> list[dict[str, Any]]:
    """Return a row for each skill."""
    total = all_steps(reports)
    longest = max(scale_of(report.length_mean for report in reports.values()), 10)
    rows = []
    for name, report in reports.items():
        calls = report.calls
        known = bool(report.ended and calls)
        rows.append(
            {
                "name": name,
                "share": report.steps / total if total else 0.0,
                "percent": percent(report.steps / total if total else 0.0),
                "calls": f"{calls:,}",
                "length": number(report.length_mean, longest),
                "ends": end_cells(report.ended, report.own_with_episode, calls if known else 0),
                "success": percent(report.success_rate),
                "return": number(report.return_mean),
            }
        )
    return rows


def end_cells(reasons: Mapping[str, int], own_with_episode: int, calls: int) -> list[str]:
    """Return the shares of the ends of calls; 0 ``calls``: unknown."""
    cells = [percent(reasons[why] / calls if calls else None) for why in WHY]
    if own_with_episode:
        cells[0] += f" ({percent(own_with_episode / calls)} in the last step)"
    return cells


def about(skill: Skill) -> str:
    """Return the first paragraph of a skill's docstring; empty where it has none."""
    for kind in type(skill).__mro__[: type(skill).__mro__.index(Skill)]:
        if text := inspect.cleandoc(kind.__doc__ or ""):
            return " ".join(text.split("\n\n")[0].split()).replace("``", "`")
    return ""


def reflex_rows(reflexes: Mapping[str, int], total: int) -> list[dict[str, Any]]:
    """Return a row for each reflex: in how many of ``total`` steps it acted."""
    return [
        {
            "name": name,
            "steps": f"{steps:,}",
            "share": steps / total,
            "percent": percent(steps / total),
        }
        for name, steps in reflexes.items()
    ]


def transitions(reports: Mapping[str, SkillReport]) -> list[list[int]] | None:
    """Return how often each skill followed another: (1 + S, S + 1); None: not known.

    The first row is an episode's start, the last column its end.
    """
    names = list(reports)
    if not names or not all(set(r.followed) == set(names) for r in reports.values()):
        return None
    rows = [[reports[name].first for name in names] + [0]]
    for report in reports.values():
        after = [report.followed[name] for name in names]
        rows.append([*after, report.calls - sum(after)])
    return rows


def transition_rows(
    labels: Sequence[str], counts: Sequence[Sequence[float]]
) -> list[dict[str, Any]]:
    """Return a row for each skill and for an episode's start: counts and shares of successors."""
    rows = []
    for name, row in zip(("start of an episode", *labels), counts, strict=True):
        total = sum(row)
        shares = [n / total if total else 0.0 for n in row]
        cells = [
            {"count": f"{n:,.0f}", "share": share, "percent": percent(share)}
            for n, share in zip(row, shares, strict=True)
        ]
        rows.append({"name": name, "total": total, "cells": cells})
    return rows
