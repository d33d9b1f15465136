"""What each skill did, and which skill followed which, as rows for the page's tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skillweave.training.skill_report import SkillReport, all_steps

WHY = {
    "own": "by itself",
    "limit": "at a limit",
    "interrupted": "cut by the selector",
    "episode": "with the episode",
}
"""Why a call ended, as the page says it."""
NOTHING = "–"


def skill_rows(reports: Mapping[str, SkillReport]) -> list[dict[str, Any]]:
    """A row for each skill."""
    total = all_steps(reports)
    rows = []
    for name, report in reports.items():
        calls = report.calls
        known = bool(report.ended and calls)
        rows.append({
            "name": name,
            "share": report.steps / total if total else 0.0,
            "calls": f"{calls:,}",
            "length": number(report.length_mean),
            "ends": [percent(report.ended[w] / calls if known else None) for w in WHY],
            "success": percent(report.success_rate),
            "return": number(report.return_mean),
        })  # fmt: skip
    return rows


def transitions(reports: Mapping[str, SkillReport]) -> list[list[int]] | None:
    """How often each skill followed another: (1 + S, S + 1); None: not known.

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
    """A row for each skill and for an episode's start: what followed, as counts and shares."""
    rows = []
    for name, row in zip(("start of an episode", *labels), counts, strict=True):
        total = sum(row)
        cells = [{"count": f"{n:,.0f}", "share": n / total if total else 0.0} for n in row]
        rows.append({"name": name, "total": total, "cells": cells})
    return rows


def percent(value: float | None) -> str:
    """A share: 42 %."""
    return NOTHING if value is None else f"{100 * value:.0f} %"


def number(value: float | None) -> str:
    """A number with one decimal."""
    return NOTHING if value is None else f"{round(value, 1) + 0.0:,.1f}".replace("-", "−")
