"""Groups of runs that differ by their seed alone, and the settings in which groups differ.

Of the seeds' values interquartile means, and bootstrap intervals: Agarwal et al. 2021, "Deep
reinforcement learning at the edge of the statistical precipice".
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skillweave.errors import DeclarationError
from skillweave.policies.core import Array
from skillweave.reporting import facts
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import settings_of
from skillweave.training.evaluation import interquartile_means


@dataclass
class Group:
    """Seeds of one recipe."""

    key: str
    """A letter, for charts and tables."""
    name: str
    runs: list[RunDirectory]
    settings: dict[str, str]
    """In words."""


def grouped(runs: Sequence[RunDirectory]) -> list[Group]:
    """Return runs as groups of seeds, in the order of their first runs.

    Raises:
        DeclarationError: no runs, or two that have the same seed and the same settings.
    """
    if not runs:
        raise DeclarationError("no runs were given; name at least one run's directory")
    by_settings: dict[str, Group] = {}
    for run in runs:
        settings = settings_of(run.manifest)
        key = json.dumps([run.manifest.recipe, settings], sort_keys=True, default=str)
        turn, at = divmod(len(by_settings), 26)  # A to Z, then A2, B2 and so on
        letter = chr(ord("A") + at) + (str(turn + 1) if turn else "")
        words = {k: facts.plain(v) for k, v in settings.items()}
        group = by_settings.setdefault(key, Group(letter, _base(run), [], words))
        for other in group.runs:
            if other.manifest.seed == run.manifest.seed:
                raise DeclarationError(
                    f"{other.path} and {run.path} have the same settings and the same seed, "
                    f"{run.manifest.seed}; name one of them"
                )
        group.runs.append(run)
    groups = list(by_settings.values())
    alike = {g.name: [other for other in groups if other.name == g.name] for g in groups}
    for group in groups:
        names = _distinguishing(alike[group.name])
        distinct = [f"{k} {group.settings.get(k, facts.NOTHING)}" for k in names]
        group.name = ", ".join([group.name, *distinct])
    return groups


def differences(groups: Sequence[Group]) -> list[tuple[str, list[str]]]:
    """Return the settings in which groups differ: the name, and the value of each group."""
    names = dict.fromkeys(k for g in groups for k in g.settings)
    table = [(k, [g.settings.get(k, facts.NOTHING) for g in groups]) for k in names]
    return [(k, values) for k, values in table if len(set(values)) > 1]


def _base(run: RunDirectory) -> str:
    """Return the name of a run's recipe, or of its environment."""
    recipe = run.manifest.recipe
    name = Path(recipe).stem if recipe else run.manifest.env
    return f"{name}, plain agent" if recipe and run.manifest.hierarchy is None else name


def _distinguishing(groups: Sequence[Group]) -> list[str]:
    """Return few settings that distinguish the groups; each separates them best."""
    table = dict(differences(groups))
    names = list[str]()
    separate = 1

    def parts(name: str) -> int:
        """Return how many groups differ in the settings so far and this one."""
        return len({tuple(table[k][i] for k in (*names, name)) for i in range(len(groups))})

    while table and parts(best := max(table, key=parts)) > separate:
        separate = parts(best)
        names.append(best)
    return names


# Values over seeds

RESAMPLES = 2_000
GRID = 100  # points of a curve


@dataclass(frozen=True)
class OverSeeds:
    """Interquartile means over seeds, with 95 % bootstrap intervals; arrays (…)."""

    seeds: int
    mean: Array
    low: Array
    """The lower bound; of one seed it is the mean, as is ``high``."""
    high: Array

    @property
    def bounds(self) -> dict[str, float]:
        """The ``low`` and the ``high`` of a single number; empty: one seed has no interval."""
        return {"low": float(self.low), "high": float(self.high)} if self.seeds > 1 else {}

    def interval(self, say: Callable[[float], str]) -> str:
        """Return a single number's interval in words; empty: it has none."""
        return facts.span(self.bounds.values(), say)


def over_seeds(values: Array | Sequence[float]) -> OverSeeds:
    """Compute interquartile means of values (seeds, …), and their intervals; always the same."""
    x = np.asarray(values, float)
    n, mean = len(x), interquartile_means(x)
    if n < 2:
        return OverSeeds(n, mean, mean, mean)
    drawn = np.random.default_rng(0).integers(0, n, (n, RESAMPLES))
    # A resample is a column, so the first axis remains the seeds.
    low, high = np.percentile(interquartile_means(x[drawn]), (2.5, 97.5), axis=0)
    return OverSeeds(n, mean, low, high)


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
