"""Figures of a run: how a population evolved, or how an agent learnt."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from skillweave.errors import RunError, needs_extra
from skillweave.reporting.lineage import (
    Lineage,
    changes_words,
    number_of,
    read_lineage,
    setting_title,
    short_value,
)
from skillweave.reporting.palette import color_of, hex_of
from skillweave.runs.directory import RunDirectory, file_name
from skillweave.runs.files import written
from skillweave.runs.hub import must_be_own
from skillweave.runs.manifest import LineageLine

FAINT = "#c9c9cf"
"""The colour of members that did not lead to the winner."""
TEXT = "#4a4a52"
"""The colour of notes."""


def plot_run(run: RunDirectory, out: Path | None = None) -> list[Path]:
    """Draw every stage that has something to show, as PNG and SVG; return the files.

    A stage that evolved: fitness by generation with the winner's family tree, and the path of each
    setting. Any other: its return over the steps.

    Args:
        out: a directory; None: ``plots`` in the run.

    Raises:
        RunError: nothing was trained yet, or matplotlib is missing.
    """
    with needs_extra("plotting", "plot"):
        from matplotlib.figure import Figure
    folder = out or run.path / "plots"
    paths = []
    must_be_own(folder)
    metrics = list(run.metrics())
    for i, stage in enumerate(run.manifest.stages):
        name = stage.name
        color = hex_of(color_of(i + 1))
        if lineage := read_lineage(run, name):
            figure = _draw_lineage(Figure, lineage, name, color)
        else:
            mine = [
                m for m in metrics if m.get("stage") == name and {"return", "steps"} <= m.keys()
            ]
            if not mine:
                continue
            figure = Figure(figsize=(8, 4), layout="constrained")
            axes = figure.add_subplot()
            curve = [m["steps"] for m in mine], [m["return"] for m in mine]
            axes.plot(*curve, color=color, linewidth=1.8)
            axes.set_title(f"{name}: return while training", loc="left", fontsize=12)
            _plain(axes, "mean return of 100 episodes", "environment steps")
        for suffix in (".png", ".svg"):
            path = folder / f"{file_name(name)}{suffix}"
            with written(path):
                folder.mkdir(parents=True, exist_ok=True)
                figure.savefig(path, dpi=120)
            paths.append(path)
    if not paths:
        lines = run.path / "metrics.jsonl"
        why = "no episode has ended" if lines.exists() else f"there is no {lines}"
        raise RunError(f"{run.path} holds nothing to draw: {why}")
    return paths


def _draw_lineage(make: Any, lineage: Lineage, name: str, color: str) -> Any:
    """Draw fitness by generation, and below it the path of each setting that differs."""
    path = lineage.path(lineage.winner)
    shown = lineage.varied
    rows = -(-len(shown) // 2)
    figure = make(figsize=(10, 4.2 + 1.9 * rows), layout="constrained")
    grid = figure.add_gridspec(1 + rows, 2, height_ratios=[4.0, *[1.8] * rows])
    top = figure.add_subplot(grid[0, :])
    _draw_fitness(top, lineage, path, color)
    top.set_title(f"{name}: fitness by generation", loc="left", fontsize=12)
    for i, setting in enumerate(shown):
        axes = figure.add_subplot(grid[1 + i // 2, i % 2])
        _draw_setting(axes, setting, lineage, path, color)
    return figure


def _draw_fitness(axes: Any, lineage: Lineage, path: Sequence[LineageLine], color: str) -> None:
    """Draw the fitness of a population's members by generation, with the winner's line."""
    for born in lineage.born.values():
        parent = lineage.parent(born)
        if born.fitness is None:
            continue
        if parent is not None and parent.fitness is not None:
            ends = [parent.generation, born.generation], [parent.fitness, born.fitness]
            axes.plot(*ends, color=FAINT, linewidth=0.8, zorder=1)
        axes.plot(born.generation, born.fitness, "o", color=FAINT, markersize=4, zorder=2)
    line = [b.generation for b in path], [b.fitness for b in path]
    axes.plot(*line, color=color, linewidth=2.2, marker="o", markersize=6, zorder=3)
    beside = {"textcoords": "offset points"}
    for born in path:
        if born.mutation not in ("goes on", "none", "start"):
            axes.annotate(
                changes_words(born) or "weights",
                (born.generation, born.fitness),
                xytext=(4, -6),
                rotation=-38,
                fontsize=7,
                color=TEXT,
                va="top",
                **beside,
            )
    winner = path[-1]
    at = winner.generation, winner.fitness
    axes.plot(*at, "*", color=color, markersize=16, zorder=4)
    label = f"member {winner.member}: {winner.fitness:.1f}"
    bold = {"fontsize": 9, "color": color, "weight": "bold"}
    axes.annotate(label, at, xytext=(-6, 9), ha="right", **bold, **beside)
    fitness = sorted(b.fitness for b in lineage.born.values() if b.fitness is not None)
    # One hopeless member must not squeeze all others into a line.
    low = min(fitness[len(fitness) // 20], *(b.fitness for b in path if b.fitness is not None))
    room = max(fitness[-1] - low, 1e-9)
    axes.set_ylim(low - 0.25 * room, fitness[-1] + 0.15 * room)
    _plain(axes, "mean return")


def _draw_setting(
    axes: Any, setting: str, lineage: Lineage, path: Sequence[LineageLine], color: str
) -> None:
    """Draw a setting of a population's members by generation, with the winner's line."""
    values = {id(b): number_of(b, setting) for b in lineage.born.values()}
    scale = lineage.scale(setting)
    if scale == "words":
        words = sorted(set(values.values()))
        values = {key: words.index(value) for key, value in values.items()}
        axes.set_yticks(range(len(words)), words)
    for born in lineage.born.values():
        axes.plot(born.generation, values[id(born)], "o", color=FAINT, markersize=3, zorder=1)
    line = [b.generation for b in path], [values[id(b)] for b in path]
    axes.plot(*line, color=color, linewidth=1.8, marker="o", markersize=4, zorder=2)
    if scale == "log":
        axes.set_yscale("log")
    _plain(axes, setting_title(setting))
    won = path[-1].settings[setting]
    axes.set_title(f"winner: {short_value(won)}", loc="right", fontsize=8, color=TEXT)


def _plain(axes: Any, label: str, below: str = "generation") -> None:
    """Give a figure's axes labels and plain borders."""
    axes.set_ylabel(label, fontsize=8)
    axes.set_xlabel(below, fontsize=8)
    axes.tick_params(which="both", labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    if below == "generation":
        axes.xaxis.get_major_locator().set_params(integer=True)
