"""The report that compares runs: groups of seeds, with interquartile means and intervals."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skillweave.reporting.palette import color_of, hex_of
from skillweave.reporting.report import charts, facts
from skillweave.reporting.report.calls import rounded
from skillweave.reporting.report.curves import Curves, metrics_of, read_curves
from skillweave.reporting.report.facts import (
    NOTHING,
    number,
    percent,
    scale_of,
    transition_rows,
    transitions,
)
from skillweave.reporting.report.groups import (
    Group,
    OverSeeds,
    differences,
    grouped,
    on_one_grid,
    over_seeds,
)
from skillweave.reporting.report.page import library, write_page
from skillweave.reporting.report.verdict import is_binary, solved_share
from skillweave.runs.command_words import command_words
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation_file import SavedEvaluation, load_evaluation
from skillweave.training.skill_report import SkillReport, levels_of

MOST_DIFFERENCES = 60


def write_comparison(runs: Sequence[RunDirectory], path: Path) -> dict[str, Any]:
    """Write one HTML file that compares runs; those that differ by their seed alone are a group.

    Scores and skills' figures come from the runs' saved evaluations: nothing is played.

    Returns:
        ``path``, ``bytes``, ``seconds``, and ``missing``: sentences on what is not in it.

    Raises:
        DeclarationError: a run is given twice.
        RunError: a run is damaged, or the file cannot be written.
        MissingExtra: the extra 'report' is not installed.
    """
    began = time.perf_counter()
    library()
    groups = grouped(runs)
    saved = {run.path: load_evaluation(run) for run in runs}
    scores = [[s.evaluation for run in g.runs if (s := saved[run.path])] for g in groups]
    summaries = [over_seeds([e.mean for e in some]) if some else None for some in scores]
    curves_of = {run.path: read_curves(run) for run in runs}
    all_curves = [c for curves in curves_of.values() for c in curves]
    colors = [hex_of(color_of(i)) for i in range(len(groups))]
    keys = [group.key for group in groups]
    say = _sayer([r for some in scores for e in some for r in e.returns])
    binary = say is percent
    data: dict[str, Any] = {"curves": _curves(groups, curves_of, colors), "charts": {}}
    if any(scores):
        rows = _score_rows(groups, saved, summaries)
        data["charts"] = {"scores-chart": charts.scores(keys, colors, rows, binary)}
    missing = _missing(runs, saved)
    differ = differences(groups)
    context = {
        "title": f"Comparison of {len(runs)} runs",
        "groups": [_group_words(g, s, say) for g, s in zip(groups, summaries, strict=True)],
        "binary": binary,
        "legend": [(g.key, g.name, c) for g, c in zip(groups, colors, strict=True)],
        "has_scores": any(scores),
        "skills": [
            (g.key, g.name, skill_rows, _followed([e.skills for e in some]))
            for g, some in zip(groups, scores, strict=True)
            if (skill_rows := _skill_rows([e.to_json()["skills"] for e in some]))
        ],
        "runs": [_run_row(g, run, saved[run.path], say) for g in groups for run in g.runs],
        "differences": differ[:MOST_DIFFERENCES],
        "more_differences": max(0, len(differ) - MOST_DIFFERENCES),
        "curves": [c["label"] for c in data["curves"]],
        "metrics": metrics_of(all_curves),
        "missing": missing,
    }
    written = write_page(path, "compare.html", context, data)
    return written | {"seconds": round(time.perf_counter() - began, 2), "missing": missing}


Saved = dict[Path, SavedEvaluation | None]
Say = Callable[[float | None], str]
"""Write a return for people."""


def _sayer(returns: Sequence[float]) -> Say:
    """Return the writer of returns: as percent where all are 0 or 1, else to one scale."""
    if returns and is_binary(returns):
        return percent
    return functools.partial(number, scale=scale_of(returns))


def _missing(runs: Sequence[RunDirectory], saved: Saved) -> list[str]:
    sentences = []
    for run in runs:
        if not run.finished:
            sentences.append(
                f"{run.path} is not finished; to finish it: {command_words('resume', run)}"
            )
        elif saved[run.path] is None:
            sentences.append(
                f"{run.path} has no evaluation; to make one: {command_words('evaluate', run)}"
            )
    played = {
        (e.seed, e.deterministic, len(e.evaluation.returns))
        for e in saved.values()
        if e is not None
    }
    if len(played) > 1:
        sentences.append(
            "The evaluations are not of the same episodes: their seeds, their numbers of episodes, "
            "or whether actions were sampled differ"
        )
    return [f"{line}." for line in sentences]


def _group_words(group: Group, summary: OverSeeds | None, say: Say) -> dict[str, Any]:
    seeds = ", ".join(str(run.manifest.seed) for run in group.runs)
    words = {"key": group.key, "name": group.name, "seeds": seeds, "count": len(group.runs)}
    if summary is None:
        return words | {"iqm": None}
    interval = summary.interval(say) or "one seed: no interval"
    return words | {"iqm": say(float(summary.mean)), "interval": interval}


def _score_rows(
    groups: list[Group], saved: Saved, summaries: list[OverSeeds | None]
) -> dict[str, Any]:
    """Return the rows of the chart of scores: a dot for each run, a bar for each group."""
    dots = [
        {"group": group.key, "x": score.evaluation.mean, "seed": run.manifest.seed}
        for group in groups
        for run in group.runs
        if (score := saved[run.path]) is not None
    ]
    bars = []
    for group, summary in zip(groups, summaries, strict=True):
        if summary is not None:
            bar = {"group": group.key, "x": float(summary.mean)}
            if summary.low is not None and summary.high is not None:
                bar |= {"low": float(summary.low), "high": float(summary.high)}
            bars.append(bar)
    return {"dots": dots, "bars": bars}


FIGURES: dict[str, tuple[str, Say]] = {
    "share": ("share", percent),
    "calls": ("calls", number),
    "length": ("length_mean", number),
    "success": ("success_rate", percent),
    "return": ("return_mean", number),
}
"""Columns of the table of skills, with a field of their reports and how it is written."""


def _skill_rows(reports: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return for each skill its figures over the group's seeds, as ``mean (low to high)``."""
    return [
        {"name": name}
        | {
            column: _over_seeds([skills[name][key] for skills in reports if name in skills], say)
            for column, (key, say) in FIGURES.items()
        }
        for name in dict.fromkeys(k for skills in reports for k in skills)
    ]


def _followed(evaluated: Sequence[Mapping[str, SkillReport]]) -> list[dict[str, Any]]:
    """Return transitions between skills, summed over the group's seeds; [] where one lacks them."""
    # Hierarchies below have one report here.
    reports = [levels_of(skills).get("", {}) for skills in evaluated]
    counts = [transitions(skills) for skills in reports]
    known = [c for c in counts if c is not None]
    if not known or len(known) < len(counts):
        return []
    rows: list[list[int]] = np.sum(known, axis=0).tolist()
    return transition_rows(list(reports[0]), rows)


def _over_seeds(values: Sequence[float | None], say: Say) -> str:
    known = [v for v in values if v is not None]
    if not known:
        return NOTHING
    if say is number:
        say = functools.partial(number, scale=scale_of(known))
    summary = over_seeds(known)
    interval = summary.interval(say)
    return say(float(summary.mean)) + (f" ({interval})" if interval else "")


def _run_row(
    group: Group, run: RunDirectory, saved: SavedEvaluation | None, say: Say
) -> dict[str, str]:
    score = None if saved is None else saved.evaluation.to_json()
    stages = run.manifest.stages
    return {
        "run": facts.name_of(run),
        "group": group.key,
        "seed": str(run.manifest.seed),
        "status": "finished" if run.finished else "not finished",
        "steps": f"{sum(s.steps or 0 for s in stages):,}",
        "seconds": f"{sum(s.seconds or 0.0 for s in stages):,.0f}",
        "mean": say(None if saved is None else saved.evaluation.mean),
        "iqm": say(None if score is None else score["iqm"]),
        "solved": percent(None if saved is None else solved_share(saved.evaluation)),
        "length": NOTHING if score is None else f"{score['length_mean']:,.1f}",
        "episodes": NOTHING if saved is None else str(len(saved.evaluation.returns)),
    }


def _curves(
    groups: Sequence[Group], curves_of: dict[Path, list[Curves]], colors: Sequence[str]
) -> list[dict[str, Any]]:
    """Return a chart for each agent of any group, with a line and a band for each group."""
    labels = dict.fromkeys(c.label for curves in curves_of.values() for c in curves)
    keys = [group.key for group in groups]
    charts_ = []
    for label in labels:
        points: dict[str, list[list[Any]]] = {}
        for group in groups:
            curves = [c for run in group.runs for c in curves_of[run.path] if c.label == label]
            for metric in dict.fromkeys(k for c in curves for k in c.points):
                points_of = [c.points[metric] for c in curves if metric in c.points]
                points.setdefault(metric, []).extend(_line(group.key, points_of))
        spec = charts.group_curves(label, keys, colors)
        charts_.append({"label": label, "spec": spec, "points": points})
    return charts_


def _line(name: str, curves: list[list[tuple[int, float]]]) -> list[list[Any]]:
    """Return the rows of a group's line: steps, interquartile mean, low, high, and the group."""
    gridded = on_one_grid(curves)
    if gridded is None:
        return []
    grid, values = gridded
    summary = over_seeds(values)
    low = summary.mean if summary.low is None else summary.low
    high = summary.mean if summary.high is None else summary.high
    return [
        [int(x), *map(rounded, values_at), name]
        for x, *values_at in zip(grid, summary.mean, low, high, strict=True)
    ]
