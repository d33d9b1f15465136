"""The environment and the algorithm of which many tests here make their own."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw

SMALL = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((8,)))


class Timed(gym.Env):
    """Shows something in each step, pays 1 for it, and is cut after ``length`` steps."""

    observation_space: Any = gym.spaces.Box(-50, 50, (1,), np.float32)
    action_space: Any = gym.spaces.Discrete(2)
    length: int | None = 10

    def show(self):
        """What an observation is."""
        return np.zeros(1, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.show(), {}

    def step(self, action):
        self.t += 1
        return self.show(), 1.0, False, self.t == self.length, {}
