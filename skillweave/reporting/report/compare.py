"""The report that compares runs: groups of seeds, with interquartile means and intervals."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skillweave.reporting.palette import color_of
from skillweave.reporting.report import charts, facts, group_charts
from skillweave.reporting.report.curves import Curves, metrics_of, read_curves
from skillweave.reporting.report.groups import Group, differences, grouped
from skillweave.reporting.report.numbers import NOTHING, number, percent, scale_of
from skillweave.reporting.report.page import library, write_page
from skillweave.reporting.report.seeds import OverSeeds, on_one_grid, over_seeds
from skillweave.reporting.report.skills_table import transition_rows, transitions
from skillweave.reporting.report.verdict import is_binary, solved
from skillweave.runs.command_words import command_words
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation_file import SavedEvaluation, load_evaluation
from skillweave.training.skill_report import levels_of

MOST_DIFFERENCES = 60


def write_comparison(runs: Sequence[RunDirectory], path: Path) -> dict[str, Any]:
    """Write one HTML file that compares runs; those that differ by their seed alone are a group.

    Scores and what skills did are those of the runs' saved evaluations: nothing is played.

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
    told = {run.path: read_curves(run) for run in runs}
    colors = [charts.hex_of(color_of(i)) for i in range(len(groups))]
    keys = [group.key for group in groups]
    curves = _curves(groups, told, colors)
    everything = [c for own in told.values() for c in own]
    data = {"curves": curves, "metrics": metrics_of(everything), "charts": {}}
    scores = [_scores(group, saved) for group in groups]
    say = _sayer(saved)
    if any(scores):
        rows = _score_rows(groups, saved, scores)
        binary = say is percent
        data["charts"] = {"scores-chart": group_charts.scores(keys, colors, rows, binary)}
    missing = _missing(runs, saved)
    differ = differences(groups)
    context = {
        "title": f"Comparison of {len(runs)} runs",
        "groups": [_group_words(g, s, say) for g, s in zip(groups, scores, strict=True)],
        "binary": say is percent,
        "legend": [(g.key, g.name, c) for g, c in zip(groups, colors, strict=True)],
        "has_scores": any(scores),
        "skills": [
            (g.key, g.name, own, _followed(g, saved))
            for g in groups
            if (own := _skill_rows(g, saved))
        ],
        "runs": [_run_row(g, run, saved[run.path], say) for g in groups for run in g.runs],
        "differences": differ[:MOST_DIFFERENCES],
        "more_differences": max(0, len(differ) - MOST_DIFFERENCES),
        "curves": [c["label"] for c in curves],
        "metrics": data["metrics"],
        "missing": missing,
    }
    written = write_page(path, "compare.html", context, data, None)
    return written | {"seconds": round(time.perf_counter() - began, 2), "missing": missing}


Saved = dict[Path, SavedEvaluation | None]
Say = Callable[[float | None], str]
"""Write a return for people."""


def _sayer(saved: Saved) -> Say:
    """Return how returns are written: as percent where all are 0 or 1, else to one scale."""
    returns = [r for e in saved.values() if e is not None for r in e.evaluation.returns]
    if returns and is_binary(returns):
        return percent
    return functools.partial(number, scale=scale_of(returns))


def _missing(runs: Sequence[RunDirectory], saved: Saved) -> list[str]:
    found = []
    for run in runs:
        if not run.finished:
            found.append(
                f"{run.path} is not finished; to finish it: {command_words('resume', run)}"
            )
        elif saved[run.path] is None:
            found.append(
                f"{run.path} has no evaluation; to make one: {command_words('evaluate', run)}"
            )
    played = {
        (e.seed, e.deterministic, len(e.evaluation.returns))
        for e in saved.values()
        if e is not None
    }
    if len(played) > 1:
        found.append(
            "The evaluations are not of the same episodes: their seeds, their numbers of episodes, "
            "or whether actions were sampled differ"
        )
    return [f"{line}." for line in found]


def _scores(group: Group, saved: Saved) -> list[float]:
    """The mean returns of the group's runs that were evaluated."""
    return [e.evaluation.mean for run in group.runs if (e := saved[run.path]) is not None]


def _group_words(group: Group, scores: list[float], say: Say) -> dict[str, Any]:
    seeds = ", ".join(str(run.manifest["seed"]) for run in group.runs)
    words: dict[str, Any] = {
        "key": group.key,
        "name": group.name,
        "seeds": seeds,
        "count": len(group.runs),
    }
    if not scores:
        return words | {"iqm": None}
    found = over_seeds(np.array(scores))
    return words | {"iqm": say(float(found.mean)), "interval": interval(found, say)}


def interval(found: OverSeeds, say: Say = number) -> str:
    """An interval in words."""
    if found.low is None or found.high is None:
        return "one seed: no interval"
    return f"{say(float(found.low))} to {say(float(found.high))}"


def _score_rows(groups: list[Group], saved: Saved, scores: list[list[float]]) -> dict[str, Any]:
    """What the chart of scores shows: a dot for each run, a bar and a mark for each group."""
    dots, bars = [], []
    for group, own in zip(groups, scores, strict=True):
        for run in group.runs:
            if (e := saved[run.path]) is not None:
                seed = run.manifest["seed"]
                dots.append({"group": group.key, "x": e.evaluation.mean, "seed": seed})
        if own:
            found = over_seeds(np.array(own))
            ends = {} if found.low is None or found.high is None else {
                "low": float(found.low), "high": float(found.high)
            }  # fmt: skip
            bars.append({"group": group.key, "x": float(found.mean), **ends})
    return {"dots": dots, "bars": bars}


def _skill_rows(group: Group, saved: Saved) -> list[dict[str, str]]:
    """For each skill, its figures over the group's seeds, as ``mean (low to high)``."""
    found = [e.evaluation.to_json()["skills"] for run in group.runs if (e := saved[run.path])]
    rows = []
    for name in dict.fromkeys(k for skills in found for k in skills):
        own = [skills[name] for skills in found if name in skills]
        rows.append({
            "name": name,
            "share": _told([o["share"] for o in own], percent),
            "calls": _told([o["calls"] for o in own], number),
            "length": _told([o["length_mean"] for o in own], number),
            "success": _told([o["success_rate"] for o in own], percent),
            "return": _told([o["return_mean"] for o in own], number),
        })  # fmt: skip
    return rows


def _followed(group: Group, saved: Saved) -> list[dict[str, Any]]:
    """Transitions between skills, summed over the group's seeds; none where one does not know."""
    found = [e.evaluation.skills for run in group.runs if (e := saved[run.path])]
    reports = [levels_of(skills).get("", {}) for skills in found]  # hierarchies below: one report
    counts = [transitions(skills) for skills in reports]
    known = [c for c in counts if c is not None]
    if not known or len(known) < len(counts):
        return []
    rows: list[list[int]] = np.sum(known, axis=0).tolist()
    return transition_rows(list(reports[0]), rows)


def _told(values: Sequence[float | None], say: Say) -> str:
    known = [v for v in values if v is not None]
    if not known:
        return NOTHING
    if say is number:
        say = functools.partial(number, scale=scale_of(known))
    found = over_seeds(np.array(known))
    if found.low is None or found.high is None:
        return str(say(float(found.mean)))
    return f"{say(float(found.mean))} ({say(float(found.low))} to {say(float(found.high))})"


def _run_row(
    group: Group, run: RunDirectory, saved: SavedEvaluation | None, say: Say
) -> dict[str, str]:
    told = None if saved is None else saved.evaluation.to_json()
    stages = run.manifest["stages"]
    return {
        "run": facts.name_of(run),
        "group": group.key,
        "seed": str(run.manifest["seed"]),
        "status": "finished" if run.finished else "not finished",
        "steps": f"{sum(s.get('steps', 0) for s in stages):,}",
        "seconds": f"{sum(s.get('seconds', 0.0) for s in stages):,.0f}",
        "mean": say(None if told is None else told["mean"]),
        "iqm": say(None if told is None else told["iqm"]),
        "solved": percent(_solved(saved)),
        "length": NOTHING if told is None else f"{told['length_mean']:,.1f}",
        "episodes": NOTHING if told is None else str(told["episodes"]),
    }


def _solved(saved: SavedEvaluation | None) -> float | None:
    """The share of episodes that are solved, or else at the environment's threshold."""
    if saved is None:
        return None
    count = solved(saved.evaluation)
    if count is None:
        return saved.evaluation.solved_fraction
    return count / len(saved.evaluation.returns)


def _curves(
    groups: Sequence[Group], told: dict[Path, list[Curves]], colors: Sequence[str]
) -> list[dict[str, Any]]:
    """A chart for each agent of any group, with a line and a band for each group."""
    labels = list(dict.fromkeys(c.label for own in told.values() for c in own))
    keys = [group.key for group in groups]
    found = []
    for label in labels:
        points: dict[str, list[list[Any]]] = {}
        for group in groups:
            own = [c for run in group.runs for c in told[run.path] if c.label == label]
            for metric in dict.fromkeys(k for c in own for k in c.points):
                curves = [c.points[metric] for c in own if metric in c.points]
                points.setdefault(metric, []).extend(_line(group.key, curves))
        spec = group_charts.group_curves(label, keys, colors)
        found.append({"label": label, "spec": spec, "points": points})
    return found


def _line(name: str, curves: list[list[tuple[int, float]]]) -> list[list[Any]]:
    """Rows of a group's line: steps, interquartile mean, low, high, and the group."""
    gridded = on_one_grid(curves)
    if gridded is None:
        return []
    grid, values = gridded
    found = over_seeds(values)
    low = found.mean if found.low is None else found.low
    high = found.mean if found.high is None else found.high
    return [
        [int(x), *(float(f"{v:.5g}") for v in told), name]
        for x, *told in zip(grid, found.mean, low, high, strict=True)
    ]
