"""A line of seven places, and a small learner: what the tests of two benchmarks use."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import PPO, Network

TINY = PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=Network(hidden=(8,)))


class Line(gym.Env[Any, Any]):
    """Places −3 to 3; ``goal`` pays 1 and ends it, once ``first`` was seen, if there is one."""

    observation_space = gym.spaces.Box(-3.0, 3.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, goal: int = 3, first: int | None = None, length: int = 12) -> None:
        self.goal, self.first, self.length = goal, first, length

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.steps, self.ready = 0, 0, self.first is None
        return self._obs(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        self.place = int(np.clip(self.place + 2 * action - 1, -3, 3))
        self.ready |= self.place == self.first
        there = self.ready and self.place == self.goal
        return self._obs(), float(there), there, self.steps == self.length and not there, {}

    def _obs(self) -> Any:
        return np.array([self.place], np.float32)
