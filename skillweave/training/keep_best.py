"""The weights with the best periodic evaluation of a stage, kept while it trains on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

from torch import Tensor

from skillweave.algorithms.policy import state_from
from skillweave.types import prefixed, unprefixed


class KeepBest:
    """The best evaluation of a stage so far, and what all its learners had learnt then.

    Args:
        of: what decides: the mean return, or the share of episodes that succeed (of equal ones the
            mean return). Of equal evaluations the latest counts, as it has learnt for longer.
    """

    def __init__(self, of: Literal["return", "success"]) -> None:
        self.of = of
        self.steps = 0
        """Environment steps of the stage at this evaluation."""
        self.metrics: dict[str, float] = {}
        """Of this evaluation; empty: there was none."""
        self.states: dict[str, Any] = {}
        """By name, whole states of learners, on the CPU."""

    @property
    def value(self) -> float:
        """What the best evaluation found."""
        return self.metrics[f"eval_{self.of}"]

    def see(
        self, evaluation: Mapping[str, float], steps: int, states: Callable[[], dict[str, Any]]
    ) -> None:
        """Take an evaluation into account; an empty one is none.

        Args:
            evaluation: its metrics.
            steps: of the stage.
            states: returns what learners have learnt now.
        """
        value = evaluation.get(f"eval_{self.of}", math.nan)
        if math.isnan(value):  # no evaluation, or none of its episodes could start
            return
        if self.metrics and self._rank(evaluation) < self._rank(self.metrics):
            return
        self.steps, self.metrics = steps, dict(evaluation)
        # Learners change their tensors in place.
        self.states = {name: _copied(state) for name, state in states().items()}

    def _rank(self, metrics: Mapping[str, float]) -> tuple[float, float]:
        return metrics[f"eval_{self.of}"], metrics["eval_return"]

    def header(self) -> dict[str, Any]:
        """Return what the header of a checkpoint holds."""
        if not self.metrics:
            return {}
        return {"kept_best": {"steps": self.steps, "metrics": self.metrics}}

    def tensors(self) -> dict[str, Tensor]:
        """Return what a checkpoint holds beside the header."""
        found: dict[str, Tensor] = {}
        for name, state in self.states.items():
            found |= prefixed(f"best.{name}", vars(state))
        return found

    def load(
        self,
        header: Mapping[str, Any],
        extra: Mapping[str, Tensor],
        like: Mapping[str, Any],
        where: str,
    ) -> None:
        """Go on from a checkpoint.

        Args:
            header: of the checkpoint.
            extra: its tensors beside the state.
            like: by name, states of the shapes that the learners have.
            where: the run, for messages.
        """
        if (best := header.get("kept_best")) is None:
            return
        self.steps, self.metrics = int(best["steps"]), dict(best["metrics"])
        saved = unprefixed("best", dict(extra))
        self.states = {
            name: state_from(unprefixed(name, saved), own, f"{where}: the best of {name}")
            for name, own in like.items()
        }


def _copied(state: Any) -> Any:
    return type(state)(**{k: v.clone() for k, v in vars(state).items()})
