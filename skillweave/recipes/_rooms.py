"""The rooms of the recipe ``keys-and-doors``: MiniGrid, alone and in EnvPool, seen as cells."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import EnvSpec
from skillweave.envs import envpool
from skillweave.errors import DeclarationError, needs_extra
from skillweave.recipes._specs import named
from skillweave.types import Array, Memory, Memoryless

SMALL = (
    "DoorKey-8x8",
    "KeyCorridorS3R1",
    "MultiRoom-N2-S4",
    "MultiRoom-N4-S5",
    "ObstructedMaze-1Dl",
    "ObstructedMaze-1Dlh",
    "UnlockPickup",
    "BlockedUnlockPickup",
    "PutNear-8x8-N3",
    "SimpleCrossingS9N1",
    "Empty-Random-6x6",
)
"""The rooms in which skills are learnt: each episode is in one of them."""
TARGETS = {
    "unlock-pickup": "UnlockPickup",
    "blocked-unlock-pickup": "BlockedUnlockPickup",
    "door-key-16x16": "DoorKey-16x16",
    "multi-room": "MultiRoom-N6",
    "key-corridor": "KeyCorridorS3R3",
    "obstructed-maze": "ObstructedMaze-1Dlh",
}
"""Tasks by name, with MiniGrid's names."""
ROOMS = {"small": SMALL} | {name: (room,) for name, room in TARGETS.items()}
EMPTY = 1
WALL = 2
FLOOR = 3
DOOR = 4
KEY = 5
BALL = 6
BOX = 7
GOAL = 8
"""Kinds of a cell: the first of its three numbers."""
OPEN = 0
CLOSED = 1
LOCKED = 2
"""A door's state: the third."""
DISTANCE = np.abs(np.arange(7) - 3)[:, None] + np.abs(np.arange(7) - 6)[None]
"""Steps from the agent to each cell in view, (7, 7)."""
FAR = 14
"""More than to any of them."""
LEFT, RIGHT, FORWARD, PICK_UP, DROP, TOGGLE = range(6)
HIGHEST = np.broadcast_to(np.array([10, 5, 2], np.uint8), (7, 7, 3))
"""Kind, colour and state of a cell are never higher. MiniGrid's own space has 255."""
SPACE = gym.spaces.Box(0, HIGHEST, dtype=np.uint8)
ACTIONS = gym.spaces.Discrete(7)


def ahead(obs: Array) -> Array:
    """Return the cell before the agent, (n, 3)."""
    cell: Array = obs[:, 3, 5]
    return cell


def holds(obs: Array, *kinds: int) -> Array:
    """Return whether the agent holds one of these kinds, (n,) bool; no kinds: anything."""
    held: Array = _one_of(*(kinds or (KEY, BALL, BOX)))[obs[:, 3, 6, 0]]
    return held


def seen(obs: Array, *kinds: int, state: int | None = None) -> Array:
    """Return the cells with one of these kinds, without the agent's hands, (n, 7, 7) bool."""
    cells: Array = _one_of(*kinds)[obs[..., 0]]
    cells[:, 3, 6] = False
    return cells if state is None else np.logical_and(cells, obs[..., 2] == state)


def in_view(obs: Array, *kinds: int, state: int | None = None) -> Array:
    """Return whether one of these kinds is in view, outside the agent's hands, (n,) bool."""
    return anywhere(seen(obs, *kinds, state=state))


def anywhere(cells: Array) -> Array:
    """Return whether a cell of (n, 7, 7) bool is marked, (n,) bool."""
    any_cell: Array = np.any(cells, axis=(1, 2))
    return any_cell


def steps_to(cells: Array) -> Array:
    """Return the steps (n,) to the nearest marked cell of (n, 7, 7), obstacles ignored.

    ``FAR`` where none is marked.
    """
    steps: Array = np.where(cells, DISTANCE, FAR).min(axis=(1, 2))
    return steps


def shut(cells: Array) -> Array:
    """Return whether a cell (n, 3) is a closed or locked door, (n,) bool."""
    closed: Array = (cells[:, 0] == DOOR) & (cells[:, 2] != OPEN)
    return closed


def at_open_door(obs: Array) -> Array:
    """Return whether the agent stands before an open door, (n,) bool."""
    return open_door(ahead(obs))


def open_door(cells: Array) -> Array:
    """Return whether a cell (n, 3) is an open door, (n,) bool."""
    is_open: Array = (cells[:, 0] == DOOR) & (cells[:, 2] == OPEN)
    return is_open


def free(cells: Array) -> Array:
    """Return whether an agent can enter the cells (n, 3), (n,) bool."""
    can_enter: Array = _one_of(EMPTY, FLOOR, GOAL)[cells[:, 0]] | open_door(cells)
    return can_enter


@cache
def _one_of(*kinds: int) -> Array:
    """Return a table of these kinds, (256,) bool: much faster than ``np.isin``."""
    table = np.zeros(256, bool)
    table[list(kinds)] = True
    table.flags.writeable = False
    return table


def between_walls(obs: Array) -> Array:
    """Return whether walls are on the agent's left and right, as in a doorway, (n,) bool."""
    between: Array = (obs[:, 2, 6, 0] == WALL) & (obs[:, 4, 6, 0] == WALL)
    return between


TURNS = 4
"""It sees all four sides and keeps its direction; with one turn less it would walk in squares."""
PACES = 5
"""Steps after which it looks around again."""
ENTERING = 3
"""Steps before it first looks around: from a doorway it would not see much."""


class LookAround(Memoryless):
    """A policy that walks straight for some cells, looks to all four sides, and repeats that.

    Its memory counts turns, and steps since the last one, because an observation shows only the
    cells in front of the agent.
    """

    observation_space = SPACE
    action_space = ACTIONS

    def start(self, n: int) -> Memory:
        """Start a memory: it goes some cells before it looks."""
        return {"turns": np.full(n, TURNS), "paces": np.full(n, PACES - ENTERING)}

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return turns to the right, once around; then steps straight on, around obstacles."""
        turns = memory["turns"]
        paces = memory["paces"]
        again = (paces >= PACES) | ((paces > 0) & ~free(ahead(obs)))
        turns = np.where(again, 0, turns)
        paces = np.where(again, 0, paces)
        looks = turns < TURNS
        goes = free(ahead(obs))
        only_left = free(obs[:, 2, 6]) & ~free(obs[:, 4, 6])
        around = np.where(goes, FORWARD, np.where(only_left, LEFT, RIGHT))
        after = {"turns": turns + looks, "paces": paces + (~looks & goes)}
        return np.where(looks, RIGHT, around), after


class Rooms(gym.Env[Any, Any]):
    """One agent that starts each episode in one of several rooms, drawn evenly.

    Args:
        rooms: MiniGrid's names, without ``MiniGrid-`` and ``-v0``.
        render_mode: of MiniGrid.

    Raises:
        MissingExtra: MiniGrid is missing.
    """

    def __init__(self, rooms: Sequence[str], render_mode: str | None = None) -> None:
        with needs_extra("keys-and-doors", "minigrid"):
            import minigrid  # noqa: F401, it registers the environments
        with warnings.catch_warnings():
            # Of some rooms there is a later version, but not in EnvPool.
            warnings.filterwarnings("ignore", message=".*is out of date.*")
            self._envs = [gym.make(f"MiniGrid-{r}-v0", render_mode=render_mode) for r in rooms]
        self._now = self._envs[0]
        self.observation_space = SPACE
        self.action_space = self._now.action_space
        self.render_mode = render_mode
        self.metadata = self._now.metadata

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Draw a room, and start there."""
        super().reset(seed=seed)
        self._now = self._envs[int(self.np_random.integers(len(self._envs)))]
        room_seed = int(self.np_random.integers(2**31))
        obs, info = self._now.reset(seed=room_seed, options=options)
        return obs["image"], info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take MiniGrid's step, but pay 1 where the task is done, independent of its duration."""
        obs, reward, terminated, truncated, info = self._now.step(action)
        return obs["image"], float(float(reward) > 0), terminated, truncated, info

    def render(self) -> Any:
        """Return the picture of the room."""
        return self._now.render()

    def close(self) -> None:
        """Close all rooms."""
        for env in self._envs:
            env.close()


class RoomPool:
    """Many agents, in EnvPool's rooms; each starts every episode in one that is drawn evenly.

    Args:
        rooms: MiniGrid's names, without ``MiniGrid-`` and ``-v0``.
    """

    observation_space = SPACE
    action_space = ACTIONS

    def __init__(self, rooms: Sequence[str], num_envs: int, threads: int, seed: int) -> None:
        self._pools = [
            envpool(f"MiniGrid-{room}-v0", num_envs, threads, seed + k)
            for k, room in enumerate(rooms)
        ]
        self._rngs = [np.random.default_rng([seed, i]) for i in range(num_envs)]
        self._room = np.zeros(num_envs, np.int64)

    def reset(self, ids: Array) -> tuple[Any, dict[str, Any]]:
        """Draw rooms, and start there."""
        self._room[ids] = [self._rngs[i].integers(len(self._pools)) for i in ids]
        images = np.empty((len(ids), *SPACE.shape), np.uint8)
        for pool, rows in self._by_room(ids):
            obs, _ = pool.reset(ids[rows])
            images[rows] = obs["image"]
        return images, {}

    def step(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step each agent in its room."""
        n = len(ids)
        images = np.empty((n, *SPACE.shape), np.uint8)
        reward = np.empty(n, np.float32)
        terminated, truncated = np.empty(n, bool), np.empty(n, bool)
        by_room = self._by_room(ids)
        for pool, rows in by_room:
            pool.send(action[rows], ids[rows])
        for pool, rows in by_room:  # all rooms step at the same time
            obs, *results, _ = pool.recv()
            images[rows] = obs["image"]
            reward[rows], terminated[rows], truncated[rows] = results
        return images, (reward > 0).astype(np.float32), terminated, truncated, {}

    def _by_room(self, ids: Array) -> list[tuple[Any, Array]]:
        """Return the rooms in use, with their rows of ``ids``."""
        room = self._room[ids]
        return [(self._pools[k], np.flatnonzero(room == k)) for k in np.unique(room)]


def spec(name: str = "small") -> EnvSpec:
    """Return the rooms of this name, for ``Hierarchy(env=...)``.

    Raises:
        DeclarationError: no rooms have this name.
    """
    if name not in ROOMS:
        raise DeclarationError(f"no rooms {name!r}; there are: {', '.join(ROOMS)}")
    rooms = ROOMS[name]
    return named(f"Rooms({name})", partial(Rooms, rooms), partial(RoomPool, rooms))
