"""What every training loop tells: episodes as they end, and how an update went."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from skillweave.collecting.collector import FIRST_INFO
from skillweave.errors import TrainingError
from skillweave.types import Array

WINDOW = 100  # episodes in the reported means
INFO = "info/"
"""How names of metrics begin that are values of ``info``."""


@dataclass
class EpisodeTally:
    """Counts of episodes: logged keys of ``info`` at their ends, and the longest."""

    keys: tuple[str, ...] = ()
    """Those that are logged."""
    ended: int = 0
    """Episodes."""
    found: set[str] = field(default_factory=set)
    """Logged keys with a number in any of them."""
    others: set[str] = field(default_factory=set)
    """All keys where a logged one was absent."""
    longest: int = 0
    """Steps of the longest episode without an end, where no time limit is known."""

    @property
    def absent(self) -> tuple[str, ...]:
        """Logged keys without a number so far."""
        return tuple(key for key in self.keys if key not in self.found)

    def add(self, other: EpisodeTally) -> None:
        """Take the episodes of another tally into account, too."""
        self.keys, self.ended = other.keys, self.ended + other.ended
        self.found |= other.found
        self.others |= other.others
        self.longest = max(self.longest, other.longest)


class Episodes:
    """Numbers of the latest episodes, for people to watch.

    Args:
        log_info: keys of ``info`` that are logged.
    """

    def __init__(self, log_info: Sequence[str] = ()) -> None:
        names = "return", "task_return", "length", "success", *(INFO + k for k in log_info)
        self._windows: dict[str, deque[float]] = {k: deque(maxlen=WINDOW) for k in names}
        """By the name of the metric, in the order of the columns of ``Collected.episodes``."""
        self.tally = EpisodeTally(tuple(log_info))

    def extend(
        self, ended: Array, info_keys: frozenset[str] = frozenset(), longest: int = 0
    ) -> None:
        """Take episodes into account.

        Args:
            ended: (K, 4 + I), as ``Collected.episodes``; NaN: not told.
            info_keys: as ``Collected.info_keys``.
            longest: as ``Collected.longest``.
        """
        for column, window in enumerate(self._windows.values()):
            known = ended[:, column]
            window.extend(known[~np.isnan(known)].tolist())
        self.tally.longest = max(self.tally.longest, longest)
        if self.tally.keys:
            logged = {k: ended[:, column] for column, k in enumerate(self.tally.keys, FIRST_INFO)}
            found = {key for key, numbers in logged.items() if not np.isnan(numbers).all()}
            self.tally.add(EpisodeTally(self.tally.keys, len(ended), found, set(info_keys)))

    def state(self) -> dict[str, Array]:
        """The latest episodes, to go on from."""
        return {k: np.array(v, np.float64) for k, v in self._windows.items()}

    def load(self, state: dict[str, Array]) -> None:
        """The inverse of ``state``."""
        for name, window in self._windows.items():
            if state[name].ndim != 1 or not np.isfinite(state[name]).all():
                raise ValueError(f"{name} of the latest episodes is no row of numbers")
            window.clear()
            window.extend(state[name].tolist())

    def summary(self) -> dict[str, float]:
        """Means over the window; empty before the first episode ended."""
        return {k: float(np.mean(v)) for k, v in self._windows.items() if v}


@dataclass
class Tick:
    """What a loop reports after an update."""

    update: int
    steps: int
    since: int  # steps at the report before
    seconds: float  # of training, this process's part and those before it
    metrics: dict[str, float]
    state: Any


def to_numbers(
    metrics: dict[str, Any], update: int, *, skip_diverged: bool = False
) -> dict[str, float]:
    """Member means; a value that is not finite stops the run, saying which and where.

    If ``skip_diverged`` it is left out of the mean: who trains a population replaces its member.
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
