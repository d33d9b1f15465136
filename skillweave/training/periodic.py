"""Evaluating an agent while it trains: whole episodes in environments of their own."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from skillweave.collecting.collector import RETURN, SUCCESS, Collector
from skillweave.errors import SkillweaveError, reworded
from skillweave.seeding import Seeds
from skillweave.training.learner import crossed
from skillweave.training.scene import Scene
from skillweave.types import Array


class PeriodicEvaluation:
    """Plays ``episodes`` episodes every so many steps of training; always the same starts.

    Args:
        every: steps; None: never.
        num_envs: of training; there are no more here.

    Raises:
        EnvError: no more environments can be made beside those of training.
    """

    def __init__(
        self, scene: Scene, seeds: Seeds, every: int | None, episodes: int, num_envs: int
    ) -> None:
        self._episodes = episodes
        self._seeds, self._every = seeds / "probe", every
        self._counted = 0
        self._ended = time.monotonic()
        self.took, self.after = 0.0, 0.0
        """Seconds of the latest evaluation, and of the training before it."""
        self._arena: Collector | None = None
        if every is not None:
            self._arena = self._made(scene, min(episodes, num_envs))

    @staticmethod
    def _made(scene: Scene, num_envs: int) -> Collector:
        try:
            return scene.collector(num_envs, None)
        except SkillweaveError as error:
            raise reworded(
                error,
                f"{error}. Evaluations during training (eval_every) need {num_envs} more "
                "beside the environments of training: leave eval_every out, and evaluate the "
                "finished run",
            ) from error

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
        assert self._arena is not None
        began = time.monotonic()
        told = self._played(self._arena, play)
        self.after, self._ended = began - self._ended, time.monotonic()
        self.took = self._ended - began
        returns, success = told[:, RETURN], told[:, SUCCESS]
        found = {"eval_return": float(returns.mean()), "eval_return_min": float(returns.min())}
        if np.isnan(success).all():
            return found
        return found | {"eval_success": float((success == 1.0).mean())}

    def _played(self, arena: Collector, play: Callable[[Collector, Seeds], Array]) -> Array:
        """All episodes, (n, 4 + I): one in each environment, and again until they are enough."""
        told = [play(arena, self._seeds)]
        rounds = -(-self._episodes // arena.num_envs)
        told += [play(arena, self._seeds / "round" / i) for i in range(1, rounds)]
        return np.concatenate(told)[: self._episodes]

    def spent(self) -> int:
        """Environment steps made since this was last asked."""
        made = 0 if self._arena is None else self._arena.engine.steps_made
        since, self._counted = made - self._counted, made
        return since

    def close(self) -> None:
        """Release the environments."""
        if self._arena is not None:
            self._arena.close()
