"""A look at an agent while it trains: whole episodes in environments of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.seeding import Seeds
from skillweave.training.members import passed
from skillweave.types import Array, Policy, VecEnv

MakeEnv = Callable[[int, Any], VecEnv]
"""(num_envs, γ of a step: a number, or one for each environment) to an environment."""


def episode_returns(
    policy: Policy,
    env: VecEnv,
    seeds: Seeds,
    *,
    deterministic: bool = True,
    max_steps: int = LONGEST_EPISODE,
) -> Array:
    """The return of the first episode in each of N environments, (N,) float64, undiscounted.

    Equal seeds give equal starts, whoever plays. An episode that nothing has ended after
    ``max_steps`` counts as it stands then.
    """
    n = env.num_envs
    rng = (seeds / "act").numpy()
    obs, memory, mask = env.reset(seeds / "start"), policy.start(n), env.mask()
    returns, lengths, playing = np.zeros(n), np.zeros(n, np.int64), np.ones(n, bool)
    while playing.any():
        action, memory = policy.act(memory, obs, mask, deterministic=deterministic, rng=rng)
        step = env.step(action)
        returns += playing * np.asarray(step.info.get("call_return", step.reward), np.float64)
        lengths += step.steps
        playing &= ~step.ended & (lengths < max_steps)
        obs, mask = step.obs, step.mask
    return returns


class Probe:
    """Plays ``episodes`` episodes every so many steps of training; always the same starts."""

    def __init__(
        self, make_env: MakeEnv, gamma: float, seeds: Seeds, every: int | None, episodes: int
    ) -> None:
        self._make: Callable[[], VecEnv] = lambda: make_env(episodes, gamma)
        self._seeds, self._every, self._last = seeds / "probe", every, 0
        self._env: VecEnv | None = None
        self._counted = 0

    def start(self, steps: int) -> None:
        """Training stands at ``steps``: what was due until here is done."""
        self._last = steps

    def look(self, steps: int, policy: Callable[[], Policy]) -> dict[str, float]:
        """Metrics where it is time to look, else none."""
        if self._every is None or not passed(self._every, self._last, steps):
            return {}
        self._last = steps
        self._env = self._env or self._make()
        returns = episode_returns(policy(), self._env, self._seeds)
        return {"eval_return": float(returns.mean()), "eval_return_min": float(returns.min())}

    def spent(self) -> int:
        """Environment steps made since this was last asked."""
        made = 0 if self._env is None else self._env.steps_made
        since, self._counted = made - self._counted, made
        return since

    def close(self) -> None:
        """Release the environments."""
        if self._env is not None:
            self._env.close()
