"""Policies that are not learnt: plain functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.types import Array, Memory, Memoryless


class ScriptedPolicy(Memoryless):
    """A function from observations (n, *obs_shape) to actions (n, *action_shape) as a policy."""

    def __init__(
        self,
        function: Callable[[Array], Array],
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
    ) -> None:
        self.function = function
        self.observation_space, self.action_space = observation_space, action_space

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """The function's actions."""
        return np.asarray(self.function(obs)), memory
