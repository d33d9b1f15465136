"""Evaluation of an agent while it trains: whole episodes in separate environments."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from skillweave.collecting.collector import RETURN, SUCCESS, Collector
from skillweave.errors import SkillweaveError, reworded
from skillweave.seeding import Seeds
from skillweave.training.learner import crossed
from skillweave.training.learning_task import LearningTask
from skillweave.types import Array


class PeriodicEvaluation:
    """Evaluation by ``episodes`` episodes, always from the same starts, at intervals of training.

    Args:
        every: training steps between evaluations; None: no evaluations.
        num_envs: of training; the most environments of an evaluation.

    Raises:
        EnvError: the environments cannot be made beside those of training.
    """

    def __init__(
        self,
        learning_task: LearningTask,
        seeds: Seeds,
        every: int | None,
        episodes: int,
        num_envs: int,
    ) -> None:
        self._episodes = episodes
        self._seeds = seeds / "probe"
        self._every = every
        self._counted = 0
        self._ended = time.monotonic()
        self.took = 0.0
        """Seconds of the latest evaluation."""
        self.after = 0.0
        """Seconds of the training before it."""
        self._arena: Collector | None = None
        if every is not None:
            self._arena = self._make_arena(learning_task, min(episodes, num_envs))

    @staticmethod
    def _make_arena(learning_task: LearningTask, num_envs: int) -> Collector:
        try:
            return learning_task.collector(num_envs, None)
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
            play: plays an episode in each evaluation environment: (n, 4), as
                ``Collected.episodes``.
            also: evaluate at this report in any case, if there are evaluations at all.
        """
        if self._every is None or not (also or crossed(self._every, since, steps)):
            return {}
        assert self._arena is not None
        started = time.monotonic()
        rounds = -(-self._episodes // self._arena.num_envs)
        seeds = [self._seeds, *(self._seeds / "round" / i for i in range(1, rounds))]
        played = [play(self._arena, each) for each in seeds]  # (n, 4 + I) each
        episodes = np.concatenate(played)[: self._episodes]
        self.after = started - self._ended
        self._ended = time.monotonic()
        self.took = self._ended - started
        returns, success = episodes[:, RETURN], episodes[:, SUCCESS]
        metrics = {"eval_return": float(returns.mean()), "eval_return_min": float(returns.min())}
        if np.isnan(success).all():
            return metrics
        return metrics | {"eval_success": float((success == 1.0).mean())}

    def spent(self) -> int:
        """Return the environment steps since the previous call."""
        made = 0 if self._arena is None else self._arena.engine.steps_made
        since = made - self._counted
        self._counted = made
        return since

    def close(self) -> None:
        """Release the environments."""
        if self._arena is not None:
            self._arena.close()
