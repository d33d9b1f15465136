"""Sources of experience: environments that are stepped, or batches that were recorded before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch
from skillweave.errors import RunError
from skillweave.experience.acting import Request
from skillweave.experience.collector import FIRST_INFO, Collected
from skillweave.spaces import action_codec, obs_dtype, obs_shape
from skillweave.types import Array


class Source(Protocol):
    """Answers requests of learners; a function of requests, seeds and ``state``."""

    num_envs: int
    steps_made: int
    """Environment steps so far."""

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        ...

    def collect(self, request: Request) -> Collected:
        """Return ``request.rows`` rows of each environment."""
        ...

    def state(self) -> dict[str, Array]:
        """Return what ``restore`` needs; nothing changes."""
        ...

    def restore(self, state: dict[str, Array]) -> Array:
        """Continue from a ``state``; return (k,) environments that start again."""
        ...

    def differing(self) -> Array:
        """Return (k,) environments whose open trajectories end, as they were lost; once each."""
        ...

    def close(self) -> None:
        """Release what it holds."""
        ...


class Recorded:
    """Recorded batches as a source: it makes no steps, so a budget counts updates.

    Rows come in their order, and again from the first when they have ended; trajectories end there.

    Args:
        batches: by the path of each learner, "" where there is one; all with N environments.
        observation_space: of the learners.
        action_space: of the learner "", if it is there.

    Raises:
        RunError: the rows do not fit the spaces, or there are none.
    """

    def __init__(
        self,
        batches: Mapping[str, Batch],
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any] | None = None,
    ) -> None:
        self._batches, self._row, self.steps_made = dict(batches), 0, 0
        leads = {batch.lead for batch in batches.values()}
        if len(leads) != 1 or 0 in next(iter(leads)):
            raise RunError(
                f"recorded batches of rows and environments {sorted(leads)}: all need the same, "
                "and at least one of each"
            )
        ((self._rows, self.num_envs),) = leads
        shape, dtype = obs_shape(observation_space), obs_dtype(observation_space)
        for path, batch in batches.items():
            obs = batch["obs"]
            if obs.shape[2:] != shape or obs.dtype != dtype:
                raise RunError(
                    f"recorded observations{_of(path)} are {obs.dtype} {obs.shape[2:]}, but the "
                    f"learner's are {dtype} {shape}: record them in the environment that it "
                    "learns in"
                )
        if action_space is not None and "" in batches:
            action, codec = batches[""]["action"], action_codec(action_space)
            units = codec.zeros(1)
            wrong = action.shape[2:] != units.shape[1:] or action.dtype.kind != units.dtype.kind
            if wrong or (codec.discrete and not codec.multi and action.max() >= codec.size):
                raise RunError(
                    f"recorded actions are {action.dtype} {action.shape[2:]}, up to "
                    f"{action.max()}, but the learner's are of {action_space}: record them in "
                    "the environment that it learns in"
                )

    def start(self, seeds: Seeds) -> None:
        """Start at the first row, unless some were taken."""

    def collect(self, request: Request) -> Collected:
        """Return the next rows, as many as are left before the end at most."""
        first = self._row
        last = min(first + request.rows, self._rows)
        self._row = 0 if last == self._rows else last
        batches = {path: batch.rows(slice(first, last)) for path, batch in self._batches.items()}
        again = np.arange(self.num_envs) if first == 0 else np.empty(0, np.int64)
        return Collected(batches, 0, np.zeros((0, FIRST_INFO)), begun_anew=again)

    def state(self) -> dict[str, Array]:
        """Return the row that comes next."""
        return {"row": np.array([self._row])}

    def restore(self, state: dict[str, Array]) -> Array:
        """Continue at a row."""
        row = int(state["row"][0])
        if not 0 <= row < self._rows:
            raise RunError(f"the checkpoint is at row {row} of {self._rows} recorded ones")
        self._row = row
        return np.empty(0, np.int64)

    def differing(self) -> Array:
        """Return nothing: no environment is lost."""
        return np.empty(0, np.int64)

    def close(self) -> None:
        """Release nothing."""


def _of(path: str) -> str:
    return f" of {path!r}" if path else ""
