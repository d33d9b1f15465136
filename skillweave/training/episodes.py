"""What every training loop tells: episodes as they end, and how an update went."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from skillweave.types import Array, SkillweaveError, VecStep

WINDOW = 100  # episodes in the reported means


@dataclass
class Episodes:
    """Returns, lengths and successes of the latest episodes, for people to watch."""

    returns: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    task_returns: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    lengths: deque[int] = field(default_factory=lambda: deque(maxlen=WINDOW))
    successes: deque[bool] = field(default_factory=lambda: deque(maxlen=WINDOW))

    def add(self, step: VecStep, sums: Array) -> None:
        """Take one step of N environments into account.

        ``sums`` (N, 3) are the open episodes' return, return of the task and length so far.
        """
        # An options environment sums the undiscounted reward of a call apart.
        sums[:, 0] += step.info.get("call_return", step.reward)
        if "task_reward" in step.info:
            sums[:, 1] += step.info["task_reward"]
        sums[:, 2] += step.steps
        ended = step.ended
        if ended.any():
            for i in np.flatnonzero(ended):
                self.returns.append(float(sums[i, 0]))
                if "task_reward" in step.info:
                    self.task_returns.append(float(sums[i, 1]))
                self.lengths.append(int(sums[i, 2]))
                if "success" in step.info:
                    self.successes.append(bool(step.info["success"][i]))
            sums[ended] = 0.0

    def state(self) -> dict[str, Array]:
        """The latest episodes, to go on from."""
        return {k: np.array(v, np.float64) for k, v in vars(self).items()}

    def load(self, state: dict[str, Array]) -> None:
        """The inverse of ``state``."""
        for name, window in vars(self).items():
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
    seconds: float  # of training, this process's part and those before it
    metrics: dict[str, float]
    state: Any
    cut: bool  # a clean cut: resuming from this state is exact
    extra: dict[str, torch.Tensor] | None = None
    """What else resuming needs: where the environments are, and the replay buffer."""


def to_numbers(metrics: dict[str, Any], update: int, *, tolerant: bool = False) -> dict[str, float]:
    """Member means; a value that is not finite stops the run, saying which and where.

    If ``tolerant`` it is left out of the mean: whoever trains a population replaces its member.
    """
    numbers: dict[str, float] = {}
    for name, value in metrics.items():
        finite = torch.isfinite(value)
        if tolerant:
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
