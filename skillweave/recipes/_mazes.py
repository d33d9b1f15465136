"""The mazes of the recipe ``mazes``: PointMaze, alone and in EnvPool."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import EnvSpec
from skillweave.envs import PoolWrapper, envpool
from skillweave.errors import DeclarationError, needs_extra
from skillweave.recipes._specs import named
from skillweave.types import Array

MAZES = {
    "large": "PointMaze_Large-v3",
    "large-diverse": "PointMaze_Large_Diverse_GR-v3",
    "medium-diverse": "PointMaze_Medium_Diverse_GR-v3",
    "medium": "PointMaze_Medium-v3",
    "umaze": "PointMaze_UMaze-v3",
}
"""Mazes by name, and what Gymnasium-Robotics and EnvPool call them."""
PLACE = slice(0, 2)
SPEED = slice(2, 4)
GOAL = slice(4, 6)
"""Places in an observation: metres east and north, metres a second, metres."""
REACH = 0.45
"""Metres from the goal at which it is reached."""
BALL = 0.1
"""The ball's radius in metres."""
PIXELS = 32
"""Pixels of a metre in a picture."""
WALL = (60, 66, 80)
FLOOR = (235, 235, 230)
GREEN = (120, 190, 130)
ORANGE = (230, 110, 40)
SPACE = gym.spaces.Box(-np.inf, np.inf, (6,), np.float32)
ENDS: Any = {"continuing_task": False}
"""The episode ends at the goal; else PointMaze continues until its time is up."""


def flat(obs: Any) -> Array:
    """Return place, speed and goal, (..., 6) float32, of PointMaze's observation."""
    return np.concatenate([obs["observation"], obs["desired_goal"]], axis=-1, dtype=np.float32)


class Maze(gym.ObservationWrapper[Any, Any, Any]):
    """One ball in a maze, seen from above: drawn here, so films need no OpenGL.

    Args:
        env: PointMaze.
        render_mode: "rgb_array" for films.
    """

    def __init__(self, env: gym.Env[Any, Any], render_mode: str | None = None) -> None:
        super().__init__(env)
        self.observation_space = SPACE
        self._render_mode = render_mode
        self._seen = np.zeros(SPACE.shape, np.float32)

    @property
    def render_mode(self) -> str | None:  # type: ignore[override]  # Gymnasium has it so, too
        """Return the render mode that it was made with."""
        return self._render_mode

    def observation(self, observation: Any) -> Array:
        """Return place, speed and goal, (6,)."""
        self._seen = flat(observation)
        return self._seen

    def render(self) -> Any:
        """Return a picture, (H, W, 3) uint8: walls, the ball, and the goal as wide as it counts."""
        if self._render_mode is None:
            return None
        walls = walls_of(self)
        frame = np.where(walls[:, :, None], WALL, FLOOR).astype(np.uint8)
        frame = frame.repeat(PIXELS, axis=0).repeat(PIXELS, axis=1)
        height, width = frame.shape[:2]
        east = (np.arange(width) + 0.5 - width / 2) / PIXELS
        north = (height / 2 - np.arange(height) - 0.5) / PIXELS
        for where, radius, color in ((GOAL, REACH, GREEN), (PLACE, BALL, ORANGE)):
            x, y = self._seen[where]
            frame[np.hypot(east - x, north[:, None] - y) <= radius] = color
        return frame


def walls_of(env: gym.Env[Any, Any]) -> Array:
    """Return the walls of a maze, rows from the north, (rows, columns) bool."""
    maze_env: Any = env.unwrapped
    return np.array([[cell == 1 for cell in row] for row in maze_env.maze.maze_map])


class MazePool(PoolWrapper):
    """Many balls, each in its own maze."""

    def __init__(self, pool: Any) -> None:
        super().__init__(pool, SPACE)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def see(self, obs: Any, ids: Array) -> Array:
        """Return place, speed and goal, (k, 6)."""
        return flat(obs)


def make(maze: str = "large", render_mode: str | None = None) -> gym.Env[Any, Any]:
    """Make one ball in a maze; 1 is paid where it reaches its goal, and the episode ends.

    Raises:
        MissingExtra: gymnasium-robotics is missing.
    """
    with needs_extra("PointMaze", "robotics"):
        import gymnasium_robotics
        import mujoco  # noqa: F401
    gym.register_envs(gymnasium_robotics)
    return Maze(gym.make(MAZES[maze], disable_env_checker=True, **ENDS), render_mode)


def many(maze: str, num_envs: int, threads: int, seed: int) -> MazePool:
    """Make the mazes in EnvPool, several times as fast."""
    return MazePool(envpool(MAZES[maze], num_envs, threads, seed, **ENDS))


def spec(maze: str = "large") -> EnvSpec:
    """Return the maze of this name, for ``Hierarchy(env=...)``.

    Raises:
        DeclarationError: no maze has this name.
    """
    if maze not in MAZES:
        raise DeclarationError(f"no maze {maze!r}; there are: {', '.join(MAZES)}")
    return named(f"Maze({maze})", partial(make, maze), partial(many, maze))


WAYS = {"north": (-1, 0), "east": (0, 1), "south": (1, 0), "west": (0, -1)}
"""By skill, rows and columns by which the next cell is further."""
NEAR = 0.9
"""Metres from the goal at which it is in the same cell, or the next."""


class ShortestPath:
    """A selector with a map of the maze: it calls the skill that leads to the next cell.

    Args:
        maze: its name.

    Raises:
        MissingExtra: gymnasium-robotics is missing.
    """

    def __init__(self, maze: str) -> None:
        env = make(maze)
        self.walls = walls_of(env)
        env.close()
        self._next = {tuple(c): ways_to(self.walls, tuple(c)) for c in np.argwhere(~self.walls)}

    def cell(self, place: Array) -> tuple[int, int]:
        """Return the row and the column of a place (2,)."""
        rows, columns = self.walls.shape
        row, column = np.floor((rows / 2 - place[1], place[0] + columns / 2)).astype(int)
        return int(row), int(column)

    def __call__(self, obs: Array) -> Array:
        """Return the skill for each observation, (n,) by name."""
        return np.array([self._skill(one) for one in obs])

    def _skill(self, one: Array) -> str:
        if np.hypot(*(one[GOAL] - one[PLACE])) < NEAR:
            return "approach"
        ways = self._next.get(self.cell(one[GOAL]), {})  # none where a wall is
        return ways.get(self.cell(one[PLACE]), "approach")


def ways_to(walls: Array, goal: tuple[int, ...]) -> dict[tuple[int, ...], str]:
    """Return by cell the direction of the shortest way to ``goal`` (breadth first)."""
    way_from: dict[tuple[int, ...], str] = {goal: "approach"}
    queue = deque([goal])
    while queue:
        row, column = queue.popleft()
        for name, (down, right) in WAYS.items():
            before = (row - down, column - right)
            if not walls[before] and before not in way_from:
                way_from[before] = name
                queue.append(before)
    return way_from
