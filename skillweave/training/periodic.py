"""Evaluating an agent while it trains: whole episodes in environments of their own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from skillweave.collecting.collector import RETURN, SUCCESS, Collector
from skillweave.seeding import Seeds
from skillweave.training.learner import crossed
from skillweave.training.scene import Scene
from skillweave.types import Array


class PeriodicEvaluation:
    """Plays ``episodes`` episodes every so many steps of training; always the same starts."""

    def __init__(self, scene: Scene, seeds: Seeds, every: int | None, episodes: int) -> None:
        self._scene, self._episodes = scene, episodes
        self._seeds, self._every = seeds / "probe", every
        self._arena: Collector | None = None
        self._counted = 0

    def due(
        self,
        since: int,
        steps: int,
        play: Callable[[Collector, Seeds], Array],
        *,
        also: bool = False,
    ) -> dict[str, float]:
        """Evaluate if it is time to, and return metrics; else none.

        Args:
            since: steps of training at the report before.
            steps: at this one.
            play: plays an episode in each environment of an arena: (n, 4), as
                ``Collected.episodes``.
            also: evaluate at this report in any case, if there are evaluations at all.
        """
        if self._every is None or not (also or crossed(self._every, since, steps)):
            return {}
        self._arena = self._arena or self._scene.collector(self._episodes, None)
        told = play(self._arena, self._seeds)
        returns, success = told[:, RETURN], told[:, SUCCESS]
        found = {"eval_return": float(returns.mean()), "eval_return_min": float(returns.min())}
        if np.isnan(success).all():
            return found
        return found | {"eval_success": float((success == 1.0).mean())}

    def spent(self) -> int:
        """Environment steps made since this was last asked."""
        made = 0 if self._arena is None else self._arena.engine.steps_made
        since, self._counted = made - self._counted, made
        return since

    def close(self) -> None:
        """Release the environments."""
        if self._arena is not None:
            self._arena.close()
