"""Small environments of ``benchmarks.declarations``: two are dense, three are chains."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.types import Array


class _World(gym.Env[Any, Any]):
    """An environment that ends after ``limit`` steps."""

    limit = 100

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        self.begin()
        return self.obs(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        reward, done = self.move(action)
        return self.obs(), float(reward), bool(done), self.t >= self.limit, {}

    def begin(self) -> None:
        raise NotImplementedError

    def obs(self) -> Any:
        raise NotImplementedError

    def move(self, action: Any) -> tuple[float, bool]:
        raise NotImplementedError


class Reach(_World):
    """A point with inertia that is to rest at a place; the reward is its nearness (dense).

    Observation: x, y, vx, vy, the place's x and y.
    """

    observation_space = gym.spaces.Box(-2.0, 2.0, (6,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def begin(self) -> None:
        self.at, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        self.speed = np.zeros(2)

    def obs(self) -> Array:
        return np.concatenate([self.at, self.speed, self.goal]).astype(np.float32)

    def move(self, action: Array) -> tuple[float, bool]:
        self.speed = 0.9 * self.speed + 0.03 * np.clip(action, -1, 1)
        self.at = np.clip(self.at + self.speed, -1.5, 1.5)
        return 1.0 - float(np.hypot(*(self.at - self.goal))), False


class Track(_World):
    """A point that is to stay at a target which moves around a circle (dense).

    Observation: x, y, the target's x and y, and its next x and y.
    """

    observation_space = gym.spaces.Box(-2.0, 2.0, (6,), np.float32)
    action_space = gym.spaces.Discrete(5)
    moves = 0.12 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])

    def begin(self) -> None:
        self.at = self.np_random.uniform(-1, 1, 2)
        self.phase = float(self.np_random.uniform(0, 2 * np.pi))

    def target(self, ahead: int = 0) -> Array:
        phase = self.phase + 0.1 * (self.t + ahead)
        return 0.8 * np.array([np.cos(phase), np.sin(phase)])

    def obs(self) -> Array:
        return np.concatenate([self.at, self.target(), self.target(1)]).astype(np.float32)

    def move(self, action: int) -> tuple[float, bool]:
        self.at = np.clip(self.at + self.moves[action], -1.5, 1.5)
        return 1.0 - float(np.hypot(*(self.at - self.target()))), False


class Switches(_World):
    """A corridor of 21 places: three switches are to be pressed in their order (sparse).

    Observation: place, and which switches are pressed. Actions: left, right, press.
    """

    observation_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = gym.spaces.Discrete(3)
    places = (16, 3, 19)

    def begin(self) -> None:
        self.at, self.pressed = 10, 0

    def obs(self) -> Array:
        on = [float(i < self.pressed) for i in range(3)]
        return np.array([self.at / 10 - 1, *on], np.float32)

    def move(self, action: int) -> tuple[float, bool]:
        if action < 2:
            self.at = int(np.clip(self.at + (-1, 1)[action], 0, 20))
        elif self.at == self.places[self.pressed]:
            self.pressed += 1
        return float(self.pressed == 3), self.pressed == 3

    def render(self) -> None: ...


class Delivery(_World):
    """A point that is to fetch a parcel, bring it to a house, and go home (sparse).

    Observation: x, y, the parcel's x and y, whether it is carried, whether it is delivered. The
    house is at (0.8, 0.8), home at (-0.8, -0.8).
    """

    observation_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    limit = 120

    def begin(self) -> None:
        self.at = self.np_random.uniform(-1, 0, 2)
        self.parcel = np.array([self.np_random.uniform(-0.9, 0.0), self.np_random.uniform(0, 0.9)])
        self.carried = self.delivered = False

    def obs(self) -> Array:
        flags = [float(self.carried), float(self.delivered)]
        return np.array([*self.at, *self.parcel, *flags], np.float32)

    def move(self, action: Array) -> tuple[float, bool]:
        self.at = np.clip(self.at + 0.08 * np.clip(action, -1, 1), -1, 1)
        self.carried |= bool(np.hypot(*(self.at - self.parcel)) < 0.12)
        self.delivered |= self.carried and bool(np.hypot(*(self.at - 0.8)) < 0.15)
        home = self.delivered and bool(np.hypot(*(self.at + 0.8)) < 0.15)
        return float(home), home


class Locked(_World):
    """A grid of 7x7 cells, a wall with a door in the middle: key, door, goal (sparse).

    Observation: row and column, key's row and column, has the key, door is open. Actions: up, down,
    left, right, use.
    """

    observation_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
    action_space = gym.spaces.Discrete(5)
    moves = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    door, goal = (3, 3), (6, 6)

    def begin(self) -> None:
        self.at = np.array([self.np_random.integers(7), self.np_random.integers(3)])
        self.key = np.array([self.np_random.integers(7), self.np_random.integers(3)])
        self.has_key = self.open = False

    def obs(self) -> Array:
        flags = [float(self.has_key), float(self.open)]
        return np.array([*(self.at / 3 - 1), *(self.key / 3 - 1), *flags], np.float32)

    def move(self, action: int) -> tuple[float, bool]:
        if action == 4:
            self.has_key |= bool((self.at == self.key).all())
            self.open |= self.has_key and tuple(self.at) == (3, 2)
        else:
            there = np.clip(self.at + self.moves[action], 0, 6)
            if there[1] != 3 or (self.open and tuple(there) == self.door):
                self.at = there
        won = tuple(self.at) == self.goal
        return float(won), won
