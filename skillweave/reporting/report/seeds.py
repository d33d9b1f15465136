"""Several seeds of one recipe: interquartile means, and bootstrap intervals over the seeds.

Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from skillweave.training.evaluation import interquartile_means
from skillweave.types import Array

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
        return f"{say(float(self.low))} to {say(float(self.high))}"


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
