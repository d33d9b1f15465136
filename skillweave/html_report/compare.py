"""The report that compares runs: groups of seeds, with interquartile means and intervals."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skillweave.html_report import charts
from skillweave.html_report.page import Page, library
from skillweave.html_report.timelines import rounded
from skillweave.reporting import facts
from skillweave.reporting.curves import Curves, metrics_of, read_curves
from skillweave.reporting.facts import (
    NOTHING,
    is_binary,
    number,
    percent,
    scale_of,
    solved_share,
    transition_rows,
    transitions,
)
from skillweave.reporting.groups import (
    Group,
    differences,
    grouped,
    on_one_grid,
    over_seeds,
)
from skillweave.reporting.palette import color_of, hex_of
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
    page = Page()
    library()
    groups = grouped(runs)
    differ = differences(groups)
    saved = {run.path: load_evaluation(run) for run in runs}
    curves_of = {run.path: read_curves(run) for run in runs}
    colors = [hex_of(color_of(i)) for i in range(len(groups))]
    returns = [r for s in saved.values() if s is not None for r in s.evaluation.returns]
    binary = bool(returns) and is_binary(returns)
    say = percent if binary else functools.partial(number, scale=scale_of(returns))
    page.missing += _missing(runs, saved)
    page.data["curves"] = _curves(groups, curves_of, colors)
    page.context = {
        "title": f"Comparison of {len(runs)} runs",
        "binary": binary,
        "runs": [_run_row(g, run, saved[run.path], say) for g in groups for run in g.runs],
        "differences": differ[:MOST_DIFFERENCES],
        "more_differences": max(0, len(differ) - MOST_DIFFERENCES),
        "metrics": metrics_of([c for curves in curves_of.values() for c in curves]),
    }
    _add_groups(page, groups, colors, saved, say)
    return page.write(path, "compare.html") | {"missing": page.missing}


Saved = Mapping[Path, SavedEvaluation | None]
Say = Callable[[float | None], str]
"""Write a number for people; returns are percent where all are 0 or 1, else to one scale."""


def _missing(runs: Sequence[RunDirectory], saved: Saved) -> list[str]:
    """Return sentences on runs without an evaluation, and on evaluations that differ."""
    sentences = []
    for run in runs:
        if not run.finished:
            sentences.append(
                f"{run.path} is not finished; to finish it: {command_words('resume', run)}."
            )
        elif saved[run.path] is None:
            sentences.append(
                f"{run.path} has no evaluation; to make one: {command_words('evaluate', run)}."
            )
    if len({(s.seed, s.deterministic, len(s.evaluation.returns)) for s in saved.values() if s}) > 1:
        sentences.append(
            "The evaluations are not of the same episodes: their seeds, their numbers of episodes, "
            "or whether actions were sampled differ."
        )
    return sentences


def _add_groups(
    page: Page, groups: Sequence[Group], colors: Sequence[str], saved: Saved, say: Say
) -> None:
    """Put the groups into the page: their scores, with a chart, and the figures of their skills."""
    page.context["groups"] = []
    dots = []
    bars = []
    for group, color in zip(groups, colors, strict=True):
        scored = [(run, s.evaluation) for run in group.runs if (s := saved[run.path]) is not None]
        words: dict[str, Any] = {"key": group.key, "name": group.name, "color": color}
        words["seeds"] = ", ".join(str(run.manifest.seed) for run in group.runs)
        words |= {"count": len(group.runs), "iqm": None, "skills": ()}
        page.context["groups"].append(words)
        if scored:
            summary = over_seeds([score.mean for _, score in scored])
            dots += [
                {"group": group.key, "x": score.mean, "seed": run.manifest.seed}
                for run, score in scored
            ]
            bars.append({"group": group.key, "x": float(summary.mean)} | summary.bounds)
            words |= {
                "iqm": say(float(summary.mean)),
                "interval": summary.interval(say) or "one seed: no interval",
                "skills": _skill_rows([score.to_json()["skills"] for _, score in scored]),
                "followed": _followed([score.skills for _, score in scored]),
            }
    page.data["charts"] = {}
    if dots:
        keys = [group.key for group in groups]
        spec = charts.scores(keys, colors, dots, bars, binary=page.context["binary"])
        page.data["charts"]["scores-chart"] = spec


FIGURES: dict[str, Say] = {
    "share": percent,
    "calls": number,
    "length_mean": number,
    "success_rate": percent,
    "return_mean": number,
}
"""Columns of the table of skills: fields of their reports, and how each is written."""


def _skill_rows(reports: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return for each skill its figures over the group's seeds, as ``mean (low to high)``."""
    return [
        {"name": name}
        | {
            key: _over_seeds([skills[name][key] for skills in reports if name in skills], say)
            for key, say in FIGURES.items()
        }
        for name in dict.fromkeys(k for skills in reports for k in skills)
    ]


def _followed(evaluated: Sequence[Mapping[str, SkillReport]]) -> list[dict[str, Any]]:
    """Return transitions between skills, summed over the group's seeds; [] where one lacks them."""
    # Hierarchies below have one report here.
    reports = [levels_of(skills).get("", {}) for skills in evaluated]
    counts = [transitions(skills) for skills in reports]
    known = [c for c in counts if c is not None]
    if len(known) < len(counts):
        return []
    rows: list[list[int]] = np.sum(known, axis=0).tolist()
    return transition_rows(list(reports[0]), rows)


def _over_seeds(values: Sequence[float | None], say: Say) -> str:
    """Return a skill's figure over seeds in words; unknown values are left out."""
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
    """Return a run in words, with its score where it has been evaluated."""
    stages = run.manifest.stages
    row = {
        "run": facts.name_of(run),
        "group": group.key,
        "seed": str(run.manifest.seed),
        "status": "finished" if run.finished else "not finished",
        "steps": f"{sum(s.steps or 0 for s in stages):,}",
        "seconds": f"{sum(s.seconds or 0.0 for s in stages):,.0f}",
    }
    if saved is None:
        return row | dict.fromkeys(("mean", "iqm", "solved", "length", "episodes"), NOTHING)
    score = saved.evaluation
    score_json = saved.to_json()
    return row | {
        "mean": say(score.mean),
        "iqm": say(score_json["iqm"]),
        "solved": percent(solved_share(score)),
        "length": f"{score_json['length_mean']:,.1f}",
        "episodes": str(len(score.returns)),
    }


def _curves(
    groups: Sequence[Group], curves_of: Mapping[Path, Sequence[Curves]], colors: Sequence[str]
) -> list[dict[str, Any]]:
    """Return a chart for each agent of any group, with a line and a band for each group."""
    keys = [group.key for group in groups]
    shown = []
    for label in dict.fromkeys(c.label for curves in curves_of.values() for c in curves):
        points: dict[str, list[list[Any]]] = {}
        for group in groups:
            curves = [c for run in group.runs for c in curves_of[run.path] if c.label == label]
            for metric in dict.fromkeys(k for c in curves for k in c.points):
                points_of = [c.points[metric] for c in curves if metric in c.points]
                points.setdefault(metric, []).extend(_line(group.key, points_of))
        spec = charts.group_curves(label, keys, colors)
        shown.append({"label": label, "spec": spec, "points": points})
    return shown


def _line(name: str, curves: list[list[tuple[int, float]]]) -> list[list[Any]]:
    """Return the rows of a group's line: steps, interquartile mean, low, high, and the group."""
    gridded = on_one_grid(curves)
    if gridded is None:
        return []
    summary = over_seeds(gridded[1])
    return [
        [int(x), *map(rounded, values), name]
        for x, *values in zip(gridded[0], summary.mean, summary.low, summary.high, strict=True)
    ]
