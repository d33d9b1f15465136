"""The mazes of the recipe ``mazes``: PointMaze, alone and in EnvPool, seen as six numbers."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import Array, EnvSpec, PoolWrapper, SkillweaveError, envpool
from skillweave.types import MissingExtra

MAZES = {
    "large": "PointMaze_Large-v3",
    "umaze": "PointMaze_UMaze-v3",
    "medium": "PointMaze_Medium-v3",
    "diverse": "PointMaze_Large_Diverse_GR-v3",
}
"""Mazes by name, and what Gymnasium-Robotics and EnvPool call them."""
PLACE, SPEED, GOAL = slice(0, 2), slice(2, 4), slice(4, 6)
"""Where these stand in an observation: metres east and north, metres a second, metres."""
SPACE = gym.spaces.Box(-np.inf, np.inf, (6,), np.float32)
ENDS: Any = {"continuing_task": False}
"""The episode ends at the goal; else PointMaze goes on until its time is up."""


def flat(obs: Any) -> Array:
    """Place, speed and goal, (..., 6) float32, of what PointMaze tells."""
    return np.concatenate([obs["observation"], obs["desired_goal"]], axis=-1, dtype=np.float32)


class Maze(gym.ObservationWrapper[Any, Any, Any]):
    """One ball in a maze."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = SPACE

    def observation(self, observation: Any) -> Array:
        """Place, speed and goal, (6,)."""
        return flat(observation)


class MazePool(PoolWrapper):
    """Many balls, each in a maze of its own."""

    def __init__(self, pool: Any) -> None:
        super().__init__(pool, SPACE)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def see(self, obs: Any, ids: Array) -> Array:
        """Place, speed and goal, (k, 6)."""
        return flat(obs)


def make(maze: str = "large", render_mode: str | None = None) -> gym.Env[Any, Any]:
    """One ball in a maze; 1 is paid where it reaches its goal, and the episode ends.

    Raises:
        MissingExtra: Gymnasium-Robotics is missing.
    """
    try:
        import gymnasium_robotics
    except ImportError as error:
        raise MissingExtra("PointMaze", "robotics") from error
    gym.register_envs(gymnasium_robotics)
    return Maze(gym.make(MAZES[maze], render_mode=render_mode, disable_env_checker=True, **ENDS))


def many(maze: str, num_envs: int, threads: int, seed: int) -> MazePool:
    """The same in EnvPool, several times as fast."""
    return MazePool(envpool(MAZES[maze], num_envs, threads, seed, **ENDS))


def spec(maze: str = "large") -> EnvSpec:
    """The maze of this name, for ``Hierarchy(env=...)``.

    Raises:
        SkillweaveError: there is none of this name.
    """
    if maze not in MAZES:
        raise SkillweaveError(f"no maze {maze!r}; there are: {', '.join(MAZES)}")

    def ball(render_mode: str | None = None) -> gym.Env[Any, Any]:
        return make(maze, render_mode)

    ball.__name__ = f"Maze({maze})"
    return EnvSpec(ball, pool=partial(many, maze))
