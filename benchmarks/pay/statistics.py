"""Interquartile means and their stratified bootstrap intervals (Agarwal et al. 2021, rliable)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skillweave.training.evaluation import interquartile_mean
from skillweave.types import Array


def interval(
    scores: Sequence[Sequence[float]], *, level: float = 0.95, samples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Between which values the interquartile mean of all scores lies, by the bootstrap.

    Args:
        scores: of each task, those of its seeds. Seeds are drawn again within each task, so every
            task counts in every sample as often as it does in the scores.
        level: the share of samples within the interval.
    """
    rng, found = np.random.default_rng(seed), np.empty(samples)
    strata = [np.asarray(row, float) for row in scores]
    for i in range(samples):
        drawn = [row[rng.integers(len(row), size=len(row))] for row in strata]
        found[i] = interquartile_mean(np.concatenate(drawn))
    low, high = np.quantile(found, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def mean_of_all(scores: Sequence[Sequence[float]]) -> float:
    """Return the interquartile mean over all tasks and seeds."""
    return interquartile_mean(np.concatenate([np.asarray(row, float) for row in scores]))


def first_solved(curve: Sequence[tuple[int, float]], solved: float) -> int | None:
    """Return the steps at which a curve's score first reaches ``solved``; None: never."""
    return next((steps for steps, score in curve if score >= solved), None)


def solved_over_steps(
    curves: Sequence[Sequence[tuple[int, float]]], solved: Sequence[float], budgets: Sequence[int]
) -> Array:
    """Return the steps in all until each number of solved tasks, (1 + tasks solved, 2).

    Tasks are learnt one after another. Who has solved one goes on with the next at once; who does
    not solve it has spent its whole budget.
    """
    points, total, count = [(0, 0)], 0, 0
    for curve, bar, budget in zip(curves, solved, budgets, strict=True):
        steps = first_solved(curve, bar)
        total += budget if steps is None else steps
        if steps is not None:
            count += 1
            points.append((total, count))
    return np.array(points)
