"""Learning from data alone: gradient steps without an environment, and then perhaps with one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch
from skillweave.algorithms.config import is_offline
from skillweave.buffers.replay import ReplayStore
from skillweave.experience.acting import Request
from skillweave.experience.collector import Collected
from skillweave.experience.group import CollectorGroup
from skillweave.policies.core import Array
from skillweave.training.learner import Stack
from skillweave.training.replay_learner import ReplayLearner

ROUND = 50
"""Gradient steps of a request that steps no environment."""


def data_steps_of(config: Any, budget: int) -> int:
    """Return the steps of a stage that are gradient steps on data alone; 0: none."""
    return round((1.0 - config.online) * budget) if is_offline(config) else 0


class OfflineLearner(ReplayLearner):
    """A learner whose first steps are gradient steps on data; only then environments are stepped.

    Args:
        stacks, store, seeds: as of ``ReplayLearner``.
        data_steps: gradient steps on data alone.
    """

    def __init__(
        self, stacks: Sequence[Stack], store: ReplayStore, seeds: Seeds, data_steps: int
    ) -> None:
        super().__init__(stacks, store, seeds)
        self._data_steps = data_steps
        self._learns_from = self._random_until = 0
        self._on_data = 0
        """Gradient steps of the latest request on data alone; below 1: environments are stepped."""
        self.act_from_the_start()

    def request(self, update: int, steps: int, progress: float) -> Request:
        """Return a request for rows; while it learns from data alone, for so many steps."""
        request = super().request(update, steps, progress)
        self._on_data = min(ROUND, self._data_steps - steps)
        return request if self._on_data <= 0 else replace(request, rows=self._on_data)

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Store rows, if there are any; else the steps are gradient steps."""
        if batches:
            super().take(batches)
        else:
            self._transitions[1] += self._on_data

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return what a continuation needs; the store only where it holds more than the data."""
        return super().kept(requested=requested, replay=replay and self._on_data <= 0)

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Make the gradient steps that are due; return the metrics of the last one."""
        if steps > self._data_steps:
            return super().learn(update, steps, progress)
        # With overlap the next request is made before this one is learnt from.
        due = round(self._transitions[1] - self._transitions[0])
        metrics = self._learn(0, update, progress, due)
        self._transitions[0] = self._transitions[1]
        return metrics


class AfterData(CollectorGroup):
    """Collectors that step no environment while a stage learns from data alone.

    Args:
        collectors: of the steps afterwards; None: there are none.
        num_envs: of the stage.
        columns: the numbers of an episode, as in ``Collected.episodes``.
    """

    def __init__(self, collectors: CollectorGroup | None, num_envs: int, columns: int) -> None:
        super().__init__(num_envs, 1)
        self._inner = collectors
        self._no_episodes = np.zeros((0, columns))
        self.data_left = 0
        """Steps that are still gradient steps on data alone."""

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        if self._inner is not None:
            self._inner.start(seeds)

    def collect(self, request: Request) -> Collected:
        """Step each environment; while a stage learns from data alone, return no rows."""
        if self.data_left > 0 or self._inner is None:
            self.data_left -= request.rows
            self.steps_made += request.rows
            return Collected({}, request.rows, self._no_episodes)
        found = self._inner.collect(request)
        self.steps_made += found.steps
        self.restarts += self._inner.restarts
        self._inner.restarts = 0
        return found

    def state(self) -> dict[str, Array]:
        """Return the states of the collectors, for ``restore``; nothing changes."""
        inner = {} if self._inner is None else prefixed("inner", self._inner.state())
        return {"data_left": np.array([self.data_left]), **inner}

    def restore(self, state: dict[str, Array]) -> Array:
        """Restore the open episodes of ``state``; return (k,) environments that start again."""
        self.data_left = int(state["data_left"][0])
        if self._inner is None:
            return np.empty(0, np.int64)
        return self._inner.restore(unprefixed("inner", state))

    def take_restarted(self) -> Array:
        """Return the environments (k,) that could not be restored with a lost worker."""
        return np.empty(0, np.int64) if self._inner is None else self._inner.take_restarted()

    def finish(self) -> None:
        """Check at the end of training what it has left in the environments."""
        if self._inner is not None:
            self._inner.finish()

    def close(self) -> None:
        """Release the environments."""
        if self._inner is not None:
            self._inner.close()
