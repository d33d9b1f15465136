"""The table of a sweep: interquartile means over seeds, with intervals; no run is trained here."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skillweave.reporting.report.seeds import over_seeds

Result = tuple[str, int, Path, float | str]
"""Settings, seed, directory, and the mean return or an error."""


def summary(results: Sequence[Result], out: Path) -> tuple[dict[str, Any], str]:
    """Return a sweep as JSON, and as a table with a line for each choice of settings."""
    groups, failed, runs = list[dict[str, Any]](), list[dict[str, str]](), list[dict[str, Any]]()
    for settings, rows in itertools.groupby(results, lambda result: result[0]):
        returns = []
        for _, seed, path, score in rows:
            if isinstance(score, str):
                failed.append({"run": str(path), "error": score})
                continue
            returns.append(score)
            runs.append({"run": str(path), "settings": settings, "seed": seed, "return": score})
        group: dict[str, Any] = {"settings": settings or "as declared", "runs": len(returns)}
        if returns:
            over = over_seeds(np.array(returns))
            group |= {"iqm": float(over.mean), "median": statistics.median(returns)}
            group |= {"least": min(returns), "most": max(returns)}
            if over.low is not None and over.high is not None:
                group |= {"low": float(over.low), "high": float(over.high)}
        groups.append(group)
    result = {"out": str(out), "groups": groups, "runs": runs, "failed": failed}
    return result, "\n".join([*_table(groups), *_failures(failed), f"runs    {out}"])


def _table(groups: Sequence[dict[str, Any]]) -> list[str]:
    wide = max(len(g["settings"]) for g in groups)
    head = f"{'settings':<{wide}} {'runs':>5} {'return':>9} {'95 % interval':>20} {'median':>9}"
    lines = [f"{head} {'least to most':>20}"]
    for g in groups:
        line = f"{g['settings']:<{wide}} {g['runs']:>5}"
        if g["runs"]:
            interval = f"{g['low']:.1f} to {g['high']:.1f}" if "low" in g else "one seed"
            line += f" {g['iqm']:>9.1f} {interval:>20} {g['median']:>9.1f}"
            line += f" {g['least']:>9.1f} to {g['most']:.1f}".rjust(21)
        lines.append(line)
    return [*lines, "return: the interquartile mean over seeds of the runs' mean returns"]


def _failures(failed: Sequence[dict[str, str]]) -> list[str]:
    return [f"failed  {f['run']}: {f['error']}" for f in failed]
