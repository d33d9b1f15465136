"""Groups of runs that differ by their seed alone, and the settings in which groups differ.

Of the seeds' values interquartile means, and bootstrap intervals: Agarwal et al. 2021, "Deep
reinforcement learning at the edge of the statistical precipice".
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skillweave.errors import DeclarationError
from skillweave.reporting.report import facts
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import interquartile_means
from skillweave.types import Array


@dataclass
class Group:
    """Seeds of one recipe."""

    key: str
    """A letter, for charts and tables."""
    name: str
    runs: list[RunDirectory]
    settings: dict[str, Any]


def grouped(runs: Sequence[RunDirectory]) -> list[Group]:
    """Return the groups, in the order of their first runs.

    Raises:
        DeclarationError: no runs, or two that have the same seed and the same settings.
    """
    if not runs:
        raise DeclarationError("no runs were given; name at least one run's directory")
    by_settings: dict[str, Group] = {}
    for run in runs:
        settings = facts.settings(run.manifest)
        key = json.dumps([run.manifest.recipe, settings], sort_keys=True, default=str)
        new = Group(_letter(len(by_settings)), _base(run), [], settings)
        group = by_settings.setdefault(key, new)
        for other in group.runs:
            if other.manifest.seed == run.manifest.seed:
                raise DeclarationError(
                    f"{other.path} and {run.path} have the same settings and the same seed, "
                    f"{run.manifest.seed}; name one of them"
                )
        group.runs.append(run)
    groups = list(by_settings.values())
    for group in groups:
        base = _base(group.runs[0])
        same = [g for g in groups if _base(g.runs[0]) == base]
        distinct = [f"{k} {_value(group, k)}" for k in _distinguishing(same)]
        group.name = ", ".join([base, *distinct])
    return groups


def differences(groups: Sequence[Group]) -> list[tuple[str, list[str]]]:
    """Return the settings in which groups differ: the name, and the value of each group."""
    names = list(dict.fromkeys(k for g in groups for k in g.settings))
    table = [(k, [_value(g, k) for g in groups]) for k in names]
    return [(k, values) for k, values in table if len(set(values)) > 1]


def _value(group: Group, name: str) -> str:
    return facts.plain(group.settings[name]) if name in group.settings else "–"


def _base(run: RunDirectory) -> str:
    recipe = run.manifest.recipe
    name = Path(recipe).stem if recipe else run.manifest.env
    return f"{name}, plain agent" if recipe and run.manifest.hierarchy is None else name


def _distinguishing(groups: Sequence[Group]) -> list[str]:
    """Return few settings that distinguish the groups; each separates them best."""
    table = dict(differences(groups))
    names_: list[str] = []

    def parts(names: Sequence[str]) -> int:
        return len({tuple(table[k][i] for k in names) for i in range(len(groups))})

    while table and parts(names_) < len(groups):
        best = max(table, key=lambda k: parts([*names_, k]))  # the first of those that part as well
        if parts([*names_, best]) == parts(names_):
            break
        names_.append(best)
    return names_


def _letter(number: int) -> str:
    """Return A to Z, then A2, B2 and so on."""
    turn, at = divmod(number, 26)
    return chr(ord("A") + at) + (str(turn + 1) if turn else "")


# Values over seeds

RESAMPLES = 2_000
GRID = 100  # points of a curve


@dataclass(frozen=True)
class OverSeeds:
    """Interquartile means over seeds, with 95 % bootstrap intervals; arrays (…)."""

    mean: Array
    low: Array | None
    """None: one seed alone has no interval."""
    high: Array | None

    def interval(self, say: Callable[[float], str]) -> str:
        """Return a single number's interval in words; empty: it has none."""
        if self.low is None or self.high is None:
            return ""
        return facts.span((self.low, self.high), say)


def over_seeds(values: Array | Sequence[float]) -> OverSeeds:
    """Compute interquartile means of values (seeds, …), and their intervals; always the same."""
    x = np.asarray(values, float)
    n = len(x)
    if n < 2:
        return OverSeeds(interquartile_means(x), None, None)
    drawn = np.random.default_rng(0).integers(0, n, (n, RESAMPLES))
    # A resample is a column, so the first axis remains the seeds.
    means = interquartile_means(x[drawn])
    low, high = np.percentile(means, (2.5, 97.5), axis=0)
    return OverSeeds(interquartile_means(x), low, high)


def on_one_grid(curves: Sequence[Sequence[tuple[int, float]]]) -> tuple[Array, Array] | None:
    """Return curves of several seeds at the same steps: (G,) steps and (seeds, G) values.

    Between points the values are interpolated; where a curve has not started or has ended, there is
    nothing. None: they have no steps in common.
    """
    first = max(curve[0][0] for curve in curves)
    last = min(curve[-1][0] for curve in curves)
    if last < first:
        return None
    grid = np.unique(np.linspace(first, last, GRID).round())
    table = [np.interp(grid, *np.array(curve, float).T) for curve in curves]
    return grid, np.stack(table)
