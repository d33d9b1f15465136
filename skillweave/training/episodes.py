"""Reports of a training loop: ended episodes, and the metrics of updates."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from skillweave.errors import TrainingError
from skillweave.experience.collector import FIRST_INFO
from skillweave.policies.core import Array

WINDOW = 100  # episodes in the reported means
INFO = "info/"
"""Prefix of the names of metrics that are values of ``info``."""


@dataclass
class EpisodeTally:
    """Counts of episodes: logged keys of ``info`` at their ends, and the longest."""

    keys: tuple[str, ...] = ()
    """The logged keys."""
    ended: int = 0
    """Number of episodes."""
    with_number: set[str] = field(default_factory=set)
    """Logged keys that had a number in an episode."""
    others: set[str] = field(default_factory=set)
    """All keys of ``info`` in episodes without a logged key."""
    longest: int = 0
    """Steps of the longest episode without an end, where no time limit is known."""

    @property
    def absent(self) -> tuple[str, ...]:
        """Keys of ``info`` to log for which no number has come so far."""
        return tuple(key for key in self.keys if key not in self.with_number)

    def add(self, other: EpisodeTally) -> None:
        """Add the episodes of another tally."""
        self.keys = other.keys
        self.ended += other.ended
        self.with_number |= other.with_number
        self.others |= other.others
        self.longest = max(self.longest, other.longest)


class Episodes:
    """Statistics of the latest episodes, for reports.

    Args:
        log_info: keys of ``info`` that are logged.
    """

    def __init__(self, log_info: Sequence[str] = ()) -> None:
        names = "return", "task_return", "length", "success", *(INFO + k for k in log_info)
        self._windows: dict[str, deque[float]] = {k: deque(maxlen=WINDOW) for k in names}
        """Values by metric, in the order of the columns of ``Collected.episodes``."""
        self.tally = EpisodeTally(tuple(log_info))

    def extend(
        self, ended: Array, info_keys: frozenset[str] = frozenset(), longest: int = 0
    ) -> None:
        """Add episodes that ended in collectors.

        Args:
            ended: (K, 4 + I), as ``Collected.episodes``; NaN: unknown.
            info_keys: as ``Collected.info_keys``.
            longest: as ``Collected.longest``.
        """
        for column, window in enumerate(self._windows.values()):
            values = ended[:, column]
            window.extend(values[~np.isnan(values)].tolist())
        self.tally.longest = max(self.tally.longest, longest)
        if self.tally.keys:
            logged = {k: ended[:, column] for column, k in enumerate(self.tally.keys, FIRST_INFO)}
            with_number = {key for key, numbers in logged.items() if not np.isnan(numbers).all()}
            self.tally.add(EpisodeTally(self.tally.keys, len(ended), with_number, set(info_keys)))

    def state(self) -> dict[str, Array]:
        """Return the latest episodes, to continue from."""
        return {k: np.array(v, np.float64) for k, v in self._windows.items()}

    def load(self, state: dict[str, Array]) -> None:
        """Restore a ``state``."""
        for name, window in self._windows.items():
            window.clear()
            window.extend(state[name].tolist())

    def summary(self) -> dict[str, float]:
        """Return means over the window; empty before the first episode ended.

        ``return_error`` is the standard error of the mean return, from two episodes on.
        """
        means = {k: float(np.mean(v)) for k, v in self._windows.items() if v}
        if len(returns := self._windows["return"]) > 1:
            means["return_error"] = standard_error(returns)
        return means


def standard_error(values: Sequence[float]) -> float:
    """Return the standard error of the mean; of one value it is not known, so infinite."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else math.inf


@dataclass
class Tick:
    """Report of a loop after an update."""

    update: int
    steps: int
    since: int  # steps at the previous report
    seconds: float  # of training, in this process and in those before it
    metrics: dict[str, float]


def to_numbers(
    metrics: dict[str, Any], update: int, *, skip_diverged: bool = False
) -> dict[str, float]:
    """Return an update's metrics as numbers: means over the members of a population.

    A value that is not finite raises a TrainingError; with ``skip_diverged`` it is left out of the
    mean instead, as the trainer of a population replaces its member.
    """
    numbers: dict[str, float] = {}
    for name, value in metrics.items():
        finite = torch.isfinite(value)
        if skip_diverged:
            numbers |= {name: float(value[finite].mean())} if bool(finite.any()) else {}
            continue
        if not bool(finite.all()):
            member = int((~finite).nonzero()[0])
            raise TrainingError(
                f"{name} of member {member} is {float(value[member])} at update {update}: training "
                "has diverged. Lower learning_rate or max_grad_norm; the last checkpoint is intact"
            )
        numbers[name] = float(value.mean())
    return numbers
