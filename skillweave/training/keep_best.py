"""The weights with the best periodic evaluation of a stage, kept while it trains on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

from torch import Tensor

from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave.algorithms.agent_policy import state_from
from skillweave.runs.manifest import BestSoFar


class KeepBest:
    """The best evaluation of a stage so far, with the learners' states at that time.

    Args:
        of: the criterion: the mean return, or the share of episodes that succeed (then the mean
            return). Of equal evaluations the latest counts, as it learnt from more steps.
        wanted: keep the best weights; False: none, as the last ones count.
    """

    def __init__(self, of: Literal["return", "success"], wanted: bool = True) -> None:
        self.of = of
        self.wanted = wanted
        self.found: BestSoFar | None = None
        """The steps of the stage at this evaluation, and its metrics; None: none yet."""
        self.states: dict[str, Any] = {}
        """Whole states of the learners, by name, on the CPU."""

    def see(
        self, evaluation: Mapping[str, float], steps: int, states: Callable[[], dict[str, Any]]
    ) -> None:
        """Compare an evaluation with the best so far; an empty one is skipped.

        Args:
            evaluation: its metrics.
            steps: of the stage.
            states: returns the present states of the learners.
        """
        value = evaluation.get(f"eval_{self.of}", math.nan)
        if not self.wanted or math.isnan(value):  # or no evaluation, or no episode could start
            return
        if self.found and self._rank(evaluation) < self._rank(self.found.metrics):
            return
        self.found = BestSoFar(steps, dict(evaluation))
        # Learners change their tensors in place.
        self.states = {name: _copied(state) for name, state in states().items()}

    def _rank(self, metrics: Mapping[str, float]) -> tuple[float, float]:
        return metrics[f"eval_{self.of}"], metrics["eval_return"]

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors for a checkpoint."""
        tensors: dict[str, Tensor] = {}
        for name, state in self.states.items():
            tensors |= prefixed(f"best.{name}", vars(state))
        return tensors

    def load(
        self,
        found: BestSoFar | None,
        tensors: Mapping[str, Tensor],
        like: Mapping[str, Any],
        where: str,
    ) -> None:
        """Restore the best evaluation from a checkpoint.

        Args:
            found: of the checkpoint's header.
            tensors: of the checkpoint.
            like: states of the learners' shapes, by name.
            where: the run, for messages.
        """
        self.found = found
        if found is None:
            return
        saved = unprefixed("best", dict(tensors))
        self.states = {
            name: state_from(unprefixed(name, saved), example, f"{where}: the best of {name}")
            for name, example in like.items()
        }


def _copied(state: Any) -> Any:
    return type(state)(**{k: v.clone() for k, v in vars(state).items()})
