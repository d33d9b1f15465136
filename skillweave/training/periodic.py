"""Evaluating an agent while it trains: whole episodes in environments of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.seeding import Seeds
from skillweave.training.members import passed
from skillweave.training.play import FirstEpisodes, play
from skillweave.types import Array, Policy, VecEnv

MakeEnv = Callable[[int, Any], VecEnv]
"""(num_envs, γ of a step: a number, or one for each environment) to an environment."""


def first_episodes(
    policy: Policy,
    env: VecEnv,
    seeds: Seeds,
    *,
    deterministic: bool = True,
    max_steps: int = LONGEST_EPISODE,
) -> tuple[Array, Array | None]:
    """Play the first episode in each of N environments.

    Equal seeds give equal starts, whoever plays. An episode that nothing has ended after
    ``max_steps`` counts as it stands then.

    Returns:
        Undiscounted returns (N,) float64; and (N,) bool, which episodes succeeded: None where
        the environment says nothing of success.
    """
    n = env.num_envs
    returns, succeeded, told = np.zeros(n), np.zeros(n, bool), False
    episodes = FirstEpisodes(env, seeds / "start", max_steps)
    rng = (seeds / "act").numpy()
    for played in play(policy, episodes, deterministic=deterministic, rng=rng):
        counts = played.episode >= 0
        returns += counts * np.asarray(played.reward, np.float64)
        if "success" in played.step.info:
            told = True
            success = np.asarray(played.step.info["success"], bool)
            succeeded |= counts & played.over & success
    return returns, succeeded if told else None


class PeriodicEvaluation:
    """Plays ``episodes`` episodes every so many steps of training; always the same starts."""

    def __init__(
        self, make_env: MakeEnv, gamma: float, seeds: Seeds, every: int | None, episodes: int
    ) -> None:
        self._make: Callable[[], VecEnv] = lambda: make_env(episodes, gamma)
        # The node's name is that of older versions, so that their runs have the same starts.
        self._seeds, self._every, self._last = seeds / "probe", every, 0
        self._env: VecEnv | None = None
        self._counted = 0

    def start(self, steps: int) -> None:
        """Training stands at ``steps``: what was due until here is done."""
        self._last = steps

    def due(self, steps: int, policy: Callable[[], Policy]) -> dict[str, float]:
        """Evaluate where it is time to, and tell metrics; else none."""
        if self._every is None or not passed(self._every, self._last, steps):
            return {}
        self._last = steps
        self._env = self._env or self._make()
        returns, succeeded = first_episodes(policy(), self._env, self._seeds)
        found = {"eval_return": float(returns.mean()), "eval_return_min": float(returns.min())}
        return found if succeeded is None else found | {"eval_success": float(succeeded.mean())}

    def spent(self) -> int:
        """Environment steps made since this was last asked."""
        made = 0 if self._env is None else self._env.steps_made
        since, self._counted = made - self._counted, made
        return since

    def close(self) -> None:
        """Release the environments."""
        if self._env is not None:
            self._env.close()
