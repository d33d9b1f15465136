"""What every training loop tells: episodes as they end, and how an update went."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from skillweave.types import Array, SkillweaveError

WINDOW = 100  # episodes in the reported means


@dataclass
class Episodes:
    """Returns, lengths and successes of the latest episodes, for people to watch."""

    returns: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    task_returns: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    lengths: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    successes: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))

    def extend(self, ended: Array) -> None:
        """Take episodes (K, 4) into account, as ``Collected.episodes``; NaN: not told."""
        windows = self.returns, self.task_returns, self.lengths, self.successes
        for column, window in enumerate(windows):
            known = ended[:, column]
            window.extend(known[~np.isnan(known)].tolist())

    def state(self) -> dict[str, Array]:
        """The latest episodes, to go on from."""
        return {k: np.array(v, np.float64) for k, v in vars(self).items()}

    def load(self, state: dict[str, Array]) -> None:
        """The inverse of ``state``."""
        for name, window in vars(self).items():
            if state[name].ndim != 1 or not np.isfinite(state[name]).all():
                raise ValueError(f"{name} of the latest episodes are no row of numbers")
            window.clear()
            window.extend(state[name].tolist())

    def summary(self) -> dict[str, float]:
        """Means over the window; empty before the first episode ended."""
        named: dict[str, deque[Any]] = {
            "return": self.returns,
            "task_return": self.task_returns,
            "length": self.lengths,
            "success": self.successes,
        }
        return {k: float(np.mean(v)) for k, v in named.items() if v}


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
            raise SkillweaveError(
                f"{name} of member {member} is {float(value[member])} at update {update}: training "
                "has diverged. Lower learning_rate or max_grad_norm; the last checkpoint is intact"
            )
        numbers[name] = float(value.mean())
    return numbers
