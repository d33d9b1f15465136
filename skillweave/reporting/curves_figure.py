"""A figure for papers: learning curves of several seeds, as PNG and SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import as_path, short, suggest
from skillweave.errors import DeclarationError, RunError, needs_extra
from skillweave.policies.core import Array
from skillweave.reporting.curves import read_curves
from skillweave.reporting.facts import is_binary
from skillweave.reporting.groups import grouped, on_one_grid
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import written
from skillweave.runs.hub import must_be_own
from skillweave.runs.several import open_runs
from skillweave.schema import Check, fitted
from skillweave.training.evaluation_file import load_evaluation

Band = Literal["iqr", "range", "none"]
_Inches = Annotated[float, Check("from 1 to 40 inches", lambda x: 1 <= x <= 40)]
Paths: TypeAlias = str | Path | Sequence[str | Path]
Curve: TypeAlias = list[tuple[int, float]]

WIDTH = 3.3
"""Inches: a column of a two-column paper."""
FONT = 8.0
"""Points, at that width."""
DPI = 300
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito (2008): colours that people with a colour deficiency can separate."""
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (5, 1.5, 1.5, 1.5)))
"""Styles of lines, for prints without colours."""
BANDS = {"iqr": "interquartile range", "range": "lowest to highest", "none": ""}
WHOLE = ("selector", "together", "agent")
"""Kinds of stages in which the whole policy acts."""
AXES = {
    "return": "mean return",
    "eval_return": "mean return of evaluations",
    "success": "episodes solved",
    "eval_success": "episodes solved in evaluations",
}


@dataclass(frozen=True)
class Line:
    """A line of a figure, of several seeds; arrays (G,)."""

    label: str
    seeds: int
    steps: Array
    middle: Array
    low: Array | None
    """None: no band."""
    high: Array | None


@dataclass(frozen=True)
class CurvesFigure:
    """The files of a figure, and its content."""

    paths: tuple[Path, ...]
    lines: tuple[Line, ...]
    metric: str
    caption: str
    """A sentence for the paper: what lines and bands are."""


@checked_names
def plot_curves(
    runs: Paths | Mapping[str, Paths],
    out: str | Path = "curves",
    *,
    metric: str | None = None,
    agent: str | None = None,
    band: Band = "iqr",
    labels: Sequence[str] | None = None,
    width: float = WIDTH,
    height: float | None = None,
) -> CurvesFigure:
    """Draw the learning curves of several seeds: their median, and a band around it.

    The curve belongs to the whole policy. Its steps count from the start of the run, those in
    which skills learnt before included, so hierarchies and flat agents can be compared.

    Args:
        runs: directories of runs, or of sweeps; runs that differ by their seed alone are one line.
            A dict gives the lines their names: ``{"ours": "runs/a", "flat": ["b", "c"]}``.
        out: the files to write, without suffix: ``out.png`` and ``out.svg``.
        metric: of ``metrics.jsonl``; None: ``eval_return`` where every run has it, else ``return``.
        agent: a skill's name, or ``"selector"``, for a curve of it over the steps of its stages.
        band: "iqr": from the 25th to the 75th percentile of the seeds; "range": from the lowest to
            the highest; "none". One seed has no band.
        labels: names of the lines, in place of those made from settings.
        width: of the figure in inches; letters have 8 points.
        height: in inches; None: two thirds of the width, and room for the names.

    Returns:
        The files, the lines that are in them, and a sentence for the caption.

    Raises:
        DeclarationError: there is no such metric, or an argument is out of its range.
        RunError: the runs have no steps in common, or the files cannot be written.
        MissingExtra: the extra 'plot' is not installed.
    """
    out = as_path(out, "out")
    fitted(Band, band, "band")
    for name, size in (("width", width), ("height", height)):
        fitted(_Inches | None, size, name)
    must_be_own(out.parent)
    groups = _groups(runs, labels)
    everyone = [run for group in groups.values() for run in group]
    curves = {run.path: _curves_of(run, agent) for run in everyone}
    metric = _metric(everyone, curves, metric, agent)
    lines = tuple(
        _line(label, [curves[run.path][metric] for run in group], band)
        for label, group in groups.items()
    )
    binary = metric.endswith("success")
    if metric in AXES and agent is None:
        saved = [load_evaluation(run) for run in everyone]
        returns = [r for e in saved if e is not None for r in e.evaluation.returns]
        binary |= bool(returns) and is_binary(returns)
    words = AXES.get(metric, metric.replace("_", " "))
    words = words.replace("mean return", "episodes solved") if binary else words
    words = words if agent is None else f"{agent}: {words}"
    paths = _draw(lines, out, words, binary, width, height)
    return CurvesFigure(paths, lines, metric, _caption(lines, band))


def _groups(
    runs: Paths | Mapping[str, Paths], labels: Sequence[str] | None
) -> dict[str, list[RunDirectory]]:
    """Return the runs of each line of the figure, by its name."""
    if isinstance(runs, Mapping):
        groups = {str(label): open_runs(_paths(paths)) for label, paths in runs.items()}
    else:
        groups = {group.name: group.runs for group in grouped(open_runs(_paths(runs)))}
    if labels is None:
        return groups
    names = [labels] if isinstance(labels, str) else list(labels)
    if len(names) != len(groups) or len(set(names)) < len(names):
        raise DeclarationError(
            f"{len(names)} labels for {len(groups)} lines; give each line a name of its own, in "
            f"this order: {'; '.join(groups)}"
        )
    return dict(zip(names, groups.values(), strict=True))


def _paths(paths: Paths) -> list[Path]:
    listed = [paths] if isinstance(paths, str | Path) else list(paths)
    return [as_path(path, "runs") for path in listed]


def _metric(
    runs: Sequence[RunDirectory],
    curves: Mapping[Path, Mapping[str, Curve]],
    metric: str | None,
    agent: str | None,
) -> str:
    """Return the metric that the figure draws; every run has it."""
    if metric is None:
        every = all("eval_return" in curves[run.path] for run in runs)
        metric = "eval_return" if every else "return"
    for run in runs:
        metrics = curves[run.path]
        whose = "the whole policy" if agent is None else repr(agent)
        if not metrics:
            agents = ", ".join(dict.fromkeys(c.agent for c in read_curves(run))) or "none yet"
            raise DeclarationError(
                f"{run.path} has no metrics of {whose}; there are metrics of: {agents}"
            )
        if metric not in metrics:
            raise DeclarationError(
                f"{run.path} has no metric {short(metric)} of {whose}"
                f"{suggest(metric, sorted(metrics))}"
            )
    return metric


def _curves_of(run: RunDirectory, agent: str | None) -> dict[str, Curve]:
    """Return curves by metric: of an agent, or of the whole policy over all steps of the run."""
    stages = run.manifest.stages
    whole = [entry.name for entry in stages if entry.kind in WHOLE]
    points_of_stage = {
        c.stage: c.points
        for c in read_curves(run)
        if (c.agent == c.stage and c.stage in whole if agent is None else c.agent == agent)
    }
    before = 0
    joined = dict[str, Curve]()
    for entry in stages:
        # Curves one after another, each moved by the steps before it.
        for metric, points in points_of_stage.get(entry.name, {}).items():
            joined.setdefault(metric, []).extend((before + x, y) for x, y in points)
        # An agent's steps are the steps of the stages in which it learns.
        if agent is None or entry.name in points_of_stage:
            before += entry.budget if entry.steps is None else entry.steps
    return joined


def _line(label: str, curves: Sequence[Curve], band: Band) -> Line:
    """Return the line of several seeds, and the band around it."""
    gridded = on_one_grid(curves)
    if gridded is None:
        raise RunError(f"the runs of {label!r} have no steps in common: train them as long")
    steps, values = gridded
    low = high = None
    if len(curves) > 1 and band != "none":
        ends = (25, 75) if band == "iqr" else (0, 100)
        low, high = np.percentile(values, ends, axis=0)
    return Line(label, len(curves), steps, np.median(values, axis=0), low, high)


def _caption(lines: Sequence[Line], band: Band) -> str:
    """Return the figure's sentence on its lines and bands."""
    counts = sorted({line.seeds for line in lines})
    if counts == [1]:
        return "Lines: one seed each."
    seeds = " to ".join(str(n) for n in dict.fromkeys((counts[0], counts[-1])))
    shown = "" if band == "none" else f"; bands: {BANDS[band]}"
    return f"Lines: median of {seeds} seeds{shown}."


def _draw(
    lines: Sequence[Line],
    out: Path,
    words: str,
    binary: bool,
    width: float,
    height: float | None,
) -> tuple[Path, ...]:
    """Draw a figure's lines over ``words``, the title of their axis, and write its files."""
    with needs_extra("plotting", "plot"):
        import matplotlib
        from matplotlib.figure import Figure
        from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter
    named = len(lines) > 1
    most = math.floor(width * 14)  # letters of a name that fits
    if height is None:
        height = 0.62 * width + (0.17 * len(lines) if named else 0.0)
    # The same figure is the same file.
    with matplotlib.rc_context({"font.size": FONT, "svg.hashsalt": "skillweave"}):
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = figure.add_subplot()
        for i, line in enumerate(lines):
            color, dashes = COLORS[i % len(COLORS)], DASHES[i % len(DASHES)]
            name = line.label if len(line.label) <= most else f"{line.label[: most - 1]}…"
            look: dict[str, Any] = {"linewidth": 1.4, "linestyle": dashes, "zorder": 3}
            axes.plot(line.steps, line.middle, color=color, label=name, **look)
            if line.low is not None and line.high is not None:
                band = line.steps, line.low, line.high
                axes.fill_between(*band, alpha=0.2, linewidth=0, color=color)
        axes.set_xlabel("environment steps")
        if binary:
            axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
            axes.set_ylim(-0.03, 1.03)
        axes.set_ylabel(words)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_formatter(FuncFormatter(_steps))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="#e3e3e6", linewidth=0.5)
        axes.set_axisbelow(True)
        if named:
            figure.legend(loc="outside upper left", frameon=False, handlelength=2.6, borderpad=0)
        return _save(figure, out)


def _save(figure: Any, out: Path) -> tuple[Path, ...]:
    """Save the figure of learning curves as PNG and SVG."""
    stem = out.with_suffix("") if out.suffix in (".png", ".svg") else out
    paths = tuple(stem.parent / f"{stem.name}{suffix}" for suffix in (".png", ".svg"))
    with written(stem):
        stem.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(paths[0], dpi=DPI)
        figure.savefig(paths[1], metadata={"Date": None})
    return paths


def _steps(value: float, _: Any = None) -> str:
    """Return steps as an axis of a figure shows them: 200k, 1.5M."""
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e3 else f"{value:g}"
