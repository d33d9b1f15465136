"""``Balancer``: a robot on two wheels that falls unless it is driven well."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.toys.drawing import Array

STEP = 0.02
"""Seconds of a step."""
HEIGHT = 0.5
"""Metres from the axle to the middle of the body."""
GRAVITY = 9.81
DRIVE = 8.0
"""The largest acceleration of the wheels, in metres a second squared."""
SWING = 3.0
"""What the arm's motion does to the tilt, in radians a second squared."""
FALLEN = 0.6
"""The tilt, in radians, at which the robot has fallen."""


class Balancer(gym.Env[Any, Array]):
    """A robot on two wheels with an arm, as its maker's simulator has it, for ready policies.

    - **Observation**, ``Dict``: ``tilt`` (radians, forward is positive), ``gyro`` (radians a
      second), ``speed`` (metres a second), one number each.
    - **Action**, ``Box`` of two numbers from −1 to 1: the wheels' acceleration, in units of 8 m/s²,
      and how the arm swings.
    - **Reward**: 1 in each step; the episode terminates where the robot falls.
    - **Truncation**: after ``max_steps`` steps.

    Args:
        render_mode: None, as it has no pictures.
        latency: steps of 20 ms before an action has an effect.
        grip: the share of the wheels' acceleration that reaches the floor.
        max_steps: the longest episode.
    """

    metadata = {"render_modes": [], "render_fps": 50}  # noqa: RUF012  # Gymnasium's way
    observation_space = gym.spaces.Dict(
        {
            "tilt": gym.spaces.Box(-np.inf, np.inf, (1,), np.float32),
            "gyro": gym.spaces.Box(-np.inf, np.inf, (1,), np.float32),
            "speed": gym.spaces.Box(-np.inf, np.inf, (1,), np.float32),
        }
    )
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(
        self,
        render_mode: str | None = None,
        latency: int = 0,
        grip: float = 1.0,
        max_steps: int = 1000,
    ) -> None:
        self.render_mode = render_mode
        self.latency = latency
        self.grip = grip
        self.max_steps = max_steps
        self._tilt = self._gyro = self._speed = 0.0
        self._waiting: deque[tuple[float, float]] = deque()
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Put the robot upright, but for a small tilt."""
        super().reset(seed=seed)
        self._tilt, self._gyro, self._speed = self.np_random.uniform(-0.05, 0.05, 3).tolist()
        self._waiting = deque([(0.0, 0.0)] * self.latency)
        self._steps = 0
        return self._observation(), {}

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Drive for 20 ms."""
        self._steps += 1
        self._waiting.append((float(action[0]), float(action[1])))
        wheels, arm = self._waiting.popleft()
        pull = DRIVE * self.grip * min(max(wheels, -1.0), 1.0)
        turn = GRAVITY * math.sin(self._tilt) - pull * math.cos(self._tilt)
        self._gyro += STEP * (turn / HEIGHT + SWING * min(max(arm, -1.0), 1.0))
        self._tilt += STEP * self._gyro
        self._speed += STEP * pull
        fell = abs(self._tilt) > FALLEN
        return self._observation(), 1.0, fell, self._steps >= self.max_steps, {"fell": fell}

    def _observation(self) -> dict[str, Array]:
        numbers = {"tilt": self._tilt, "gyro": self._gyro, "speed": self._speed}
        return {name: np.array([value], np.float32) for name, value in numbers.items()}
