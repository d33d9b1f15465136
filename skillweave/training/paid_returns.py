"""The largest discounted return of complete episodes: critics cannot expect much more."""

from __future__ import annotations

import numpy as np

from skillweave.algorithms.batches import Batch
from skillweave.policies.core import Array

ENOUGH = 20
"""Complete episodes from which the largest return says something."""
FARTHEST = 3.0
"""The mean value of critics beyond which they overestimate, in units of the largest return."""


class PaidReturns:
    """The largest discounted return, in size, from any step of a learner's complete episodes.

    Of the calls of a skill, these are the episodes. Where time cut one off, its value goes on: it
    counts as if the same came again, 1 / (1 − γᵀ) times as much.
    """

    def __init__(self, num_envs: int) -> None:
        self.largest = 0.0
        self.episodes = 0
        self._open: list[list[tuple[float, int]]] = [[] for _ in range(num_envs)]

    def see(self, batch: Batch, gamma: float) -> None:
        """Go on with rows (T, N).

        Args:
            batch: of the learner.
            gamma: the discount of one step.
        """
        own = batch.own_rows
        reward, steps = batch["reward"], batch["steps"]
        terminated, ended = batch["terminated"], batch.ended
        for t, column in zip(*np.nonzero(own), strict=True):
            rows = self._open[column]
            rows.append((float(reward[t, column]), int(steps[t, column])))
            if ended[t, column]:
                self._close(column, gamma, cut=not terminated[t, column])

    def _close(self, column: int, gamma: float, *, cut: bool) -> None:
        """Count the returns of an episode that is over."""
        total, largest, whole = 0.0, 0.0, 1.0
        for reward, steps in reversed(self._open[column]):
            factor = gamma**steps
            total = reward + factor * total
            largest = max(largest, abs(total))
            whole *= factor
        self.largest = max(self.largest, largest / max(1.0 - whole, 1e-6) if cut else largest)
        self.episodes += 1
        self._open[column] = []

    def cut(self, columns: Array) -> None:
        """Forget the open episodes of ``columns``, whose environments were reset."""
        for column in columns:
            self._open[column] = []
