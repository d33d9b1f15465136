"""Figures and the table of a suite's results, from the files alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import median, table
from benchmarks.pay.agents import BONUS, FLAT, HIERARCHY, SHAPED, TUNED, TUNING_SEED
from benchmarks.pay.results import Result
from benchmarks.pay.statistics import interval, mean_of_all, solved_over_steps
from benchmarks.pay.suite import Suite
from skillweave.errors import MissingExtra
from skillweave.training.evaluation import interquartile_mean

LEARNERS = (HIERARCHY, FLAT, SHAPED, BONUS, TUNED)
COLORS = ("#b3261e", "#1f4e79", "#5b8a3c", "#8a6d1f", "#6a4c93")
FORMATS = ("png", "svg")


def reported(results: Sequence[Result], seeds: Sequence[int]) -> list[Result]:
    """Those of the seeds that are reported, without what was only tuned."""
    return [r for r in results if r.seed in seeds and r.seed != TUNING_SEED]


def of(results: Sequence[Result], task: str, agent: str) -> list[Result]:
    """Return an agent's results on a task, by seed."""
    found = [r for r in results if r.task == task and r.agent == agent]
    return sorted(found, key=lambda r: r.seed)


def make_table(suite: Suite, results: Sequence[Result]) -> str:
    """Return a line for each task and agent, and one for each agent over all tasks."""
    header = ("task", "agent", "steps", "IQM", "95 % interval", "median", "worst", "s", "each seed")
    agents = list(dict.fromkeys(r.agent for r in results))
    agents.sort(key=lambda a: (a != HIERARCHY, a))
    rows = []
    for task in suite.tasks:
        for agent in agents:
            if found := of(results, task.name, agent):
                rows.append((task.name, agent, *_numbers(found)))
    for agent in agents:
        each = [of(results, t.name, agent) for t in suite.tasks]
        if len(suite.tasks) > 1 and all(each):
            share = [
                [r.score / t.solved for r in found]
                for t, found in zip(suite.tasks, each, strict=True)
            ]
            low, high = interval(share)
            steps = f"{sum(r[0].steps for r in each):,}"
            mean, between = f"{mean_of_all(share):.2f}", f"{low:.2f} to {high:.2f}"
            rows.append(("all, of solved", agent, steps, mean, between, "", "", "", ""))
    return table(header, rows)


def _numbers(found: Sequence[Result]) -> tuple[str, ...]:
    scores = [r.score for r in found]
    low, high = interval([scores])
    worst = min(found, key=lambda r: r.score)
    return (
        f"{median(r.steps for r in found):,.0f}",
        f"{interquartile_mean(np.array(scores)):.2f}",
        f"{low:.2f} to {high:.2f}",
        f"{median(scores):.2f}",
        f"{worst.score:.2f} (seed {worst.seed})",
        f"{median(r.seconds for r in found):.0f}",
        " ".join(f"{s:.2f}" for s in scores),
    )


def draw(suite: Suite, results: Sequence[Result], folder: Path) -> list[Path]:
    """Draw the curves of every task, and steps against tasks solved, each as PNG and SVG.

    Raises:
        MissingExtra: matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("drawing curves", "plot") from error
    columns = len(suite.tasks)
    figure = Figure(figsize=(4.0 * columns + 1.0, 3.6), layout="constrained")
    for axes, task in zip(figure.subplots(1, columns, squeeze=False)[0], suite.tasks, strict=True):
        _curves(axes, task.name, task.solved, results)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    written = _write(figure, folder, f"{suite.name}-curves")
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    _solved(figure.subplots(), suite, results)
    return written + _write(figure, folder, f"{suite.name}-solved")


def _curves(axes: Any, title: str, solved: float, results: Sequence[Result]) -> None:
    """Interquartile means over seeds, with bands from the least to the greatest."""
    for agent, color in zip(LEARNERS, COLORS, strict=True):
        found = of(results, title, agent)
        if not found:
            continue
        last = max(r.curve[-1][0] for r in found)
        steps = np.linspace(0, last, 60)
        each = np.stack([np.interp(steps, *np.array(r.curve).T) for r in found])
        begins = steps >= max(r.curve[0][0] for r in found)
        middle = np.array([interquartile_mean(column) for column in each.T])
        axes.plot(steps[begins] / 1e6, middle[begins], color=color, label=agent)
        band = each.min(0)[begins], each.max(0)[begins]
        axes.fill_between(steps[begins] / 1e6, *band, color=color, alpha=0.15, linewidth=0)
    axes.axhline(solved, color="#999999", linewidth=0.8, linestyle="--")
    axes.set(title=title, xlabel="million steps", ylabel="score")


def _solved(axes: Any, suite: Suite, results: Sequence[Result]) -> None:
    """Total steps against the number of tasks solved, a line for each seed."""
    seeds = sorted({r.seed for r in results})
    bars = [t.solved for t in suite.tasks]
    for agent, color in zip(LEARNERS, COLORS, strict=True):
        label: str | None = agent
        for seed in seeds:
            each = [of(results, t.name, agent) for t in suite.tasks]
            own = [r for found in each for r in found if r.seed == seed]
            if len(own) < len(suite.tasks):
                continue
            line = solved_over_steps([r.curve for r in own], bars, [r.budget for r in own])
            spent = sum(r.budget for r in own)
            steps = np.append(line[:, 0], max(spent, line[-1, 0])) / 1e6
            tasks = np.append(line[:, 1], line[-1, 1])
            axes.step(steps, tasks, where="post", color=color, alpha=0.8, label=label)
            label = None
    axes.set(xlabel="total steps, millions", ylabel="tasks solved", title=suite.name)
    axes.set_yticks(range(len(suite.tasks) + 1))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)


def _write(figure: Any, folder: Path, name: str) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{name}.{kind}" for kind in FORMATS]
    for file in files:
        figure.savefig(file, dpi=150)
    return files
