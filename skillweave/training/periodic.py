"""Evaluation of an agent while it trains: whole episodes in separate environments."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from skillweave._internal.seeding import Seeds, global_generators
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.envs.checked import longest_evaluation
from skillweave.envs.engine import Engine, GymnasiumEngine, RawStep, episode_seed
from skillweave.envs.env_infos import allowed_rows
from skillweave.errors import SkillweaveError, reworded
from skillweave.experience.acting import Acting, Request
from skillweave.experience.collector import RETURN, SUCCESS, Collector
from skillweave.experience.learners import Alone, Calling
from skillweave.ops.threads import torch_threads
from skillweave.policies.core import Array
from skillweave.training.learner import crossed
from skillweave.training.learning_task import LearningTask


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
        self._engine: Engine | None = None
        if every is None:
            return
        num_envs = min(episodes, num_envs)
        try:
            self._engine = learning_task.engine(num_envs)
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
        play: Callable[[Engine, Seeds], Array],
        *,
        also: bool = False,
    ) -> dict[str, float]:
        """Evaluate the agent if it is time to, and return metrics; else none.

        Args:
            since: steps of training at the report before.
            steps: at this one.
            play: plays an episode in each evaluation environment: (n, 4), as
                ``Collected.episodes``.
            also: evaluate at this report in any case, if there are evaluations at all.
        """
        if self._every is None or not (also or crossed(self._every, since, steps)):
            return {}
        assert self._engine is not None
        started = time.monotonic()
        rounds = -(-self._episodes // self._engine.num_envs)
        seeds = [self._seeds, *(self._seeds / "round" / i for i in range(1, rounds))]
        played = [play(self._engine, each) for each in seeds]  # (n, 4 + I) each
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
        """Return the environment steps of evaluations since the previous call."""
        made = 0 if self._engine is None else self._engine.steps_made
        since = made - self._counted
        self._counted = made
        return since

    def close(self) -> None:
        """Release the environments."""
        if self._engine is not None:
            self._engine.close()


def episodes_of(
    policy: AgentPolicy,
    who: Alone | Calling,
    engine: Engine,
    seeds: Seeds,
    first: int = 0,
    count: int | None = None,
    *,
    greedy: bool = True,
    longest: int | None = None,
) -> Array:
    """Play one episode in each environment; return rows like ``Collected.episodes``.

    Args:
        who: acts, by this policy.
        first: the number of the first episode. An episode's start depends on its number alone, so
            several rounds in few environments have the same starts as one round in many.
        count: the number of environments, the first of ``engine``; None: all.
        greedy: the policy does not sample.
        longest: steps after which an episode is cut; None: by the environment's time limit.

    Returns:
        (n, 4), n at least 1; environments in which a skill could never start are left out.
    """
    algorithm = policy.algorithm
    if first or count not in (None, engine.num_envs):
        engine = cast(Engine, _Round(engine, first, count or engine.num_envs))
    # Each round has its own random streams.
    acting_seeds, global_seeds = (
        seeds / k / first if first else seeds / k for k in ("act", "global")
    )
    player = Collector(engine, Acting([(algorithm, 1)], engine.num_envs), who)
    params = algorithm.acting_params_of(policy.weights)
    gamma = np.array([algorithm.config.gamma])
    request = Request(0, (params,), gamma, acting_seeds, greedy=greedy)
    longest = longest or longest_evaluation(engine.time_limit)
    # Several threads wait for each other, forever on a busy machine.
    with torch_threads(1), global_generators(global_seeds):
        episodes: Array = player.play(request, seeds / "start", longest)
    has_started: Array = ~np.isnan(episodes[:, RETURN])
    return episodes[has_started]


class _Round:
    """The first ``num_envs`` environments of an engine, for episodes from number ``first`` on.

    Where environments take seeds, episodes start as in an engine that has one environment for
    each. Pools take none.
    """

    def __init__(self, engine: Engine, first: int, num_envs: int) -> None:
        self._engine = engine
        self._first = first
        self.num_envs = num_envs
        self._rows = np.arange(num_envs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def reset(self, seed: int) -> Array:
        """Start the episodes from one seed; return observations (num_envs, *obs_shape)."""
        engine, first = self._engine, self._first
        if not isinstance(engine, GymnasiumEngine):
            return engine.reset((Seeds(seed) / first).integer())[: self.num_envs]
        seeds = [episode_seed(seed, first + row, 0) for row in range(self.num_envs)]
        return engine.reset_some(self._rows, seeds)

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Act in environments ``ids``; None: in all of this round."""
        return self._engine.step(action, self._rows if ids is None else ids)

    def mask(self) -> Array | None:
        """Return the allowed actions (num_envs, A) bool; None: all are, always."""
        return allowed_rows(self._engine.mask(), self._rows)
