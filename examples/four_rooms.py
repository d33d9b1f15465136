"""Four rooms and their hallways: scripted skills that lead to hallways, and a selector over them.

The gridworld of Sutton, Precup & Singh 1999, "Between MDPs and semi-MDPs" (sec. 2 and 3).

    python examples/four_rooms.py
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import DQN, Apart, Hierarchy, Network, Skill
from skillweave.types import Array

PLAN = [
    "#############",
    "#     #     #",
    "#     #     #",
    "#           #",
    "#     #     #",
    "#     #     #",
    "## ####     #",
    "#     ### ###",
    "#     #     #",
    "#     #     #",
    "#           #",
    "#     #     #",
    "#############",
]
MOVES = {"up": (-1, 0), "right": (0, 1), "down": (1, 0), "left": (0, -1)}
PLACES = [(r, c) for r, row in enumerate(PLAN) for c, what in enumerate(row) if what == " "]
"""Row and column of each cell; an observation is a cell's number."""
CELL = {place: number for number, place in enumerate(PLACES)}
AFTER = np.array(
    [[CELL.get((r + dr, c + dc), CELL[r, c]) for dr, dc in MOVES.values()] for r, c in PLACES]
)
"""Where each move leads from each cell, (104, 4); a wall stops it."""
NORTH = CELL[3, 6]
WEST = CELL[6, 2]
EAST = CELL[7, 9]
SOUTH = CELL[10, 6]
CORNER = CELL[1, 1]
G1 = EAST
G2 = CELL[9, 9]
"""The upper left corner, and the paper's two kinds of goal: a hallway, and a cell inside a room."""


class FourRooms(gym.Env[Any, Any]):
    """A move goes where it should with probability 2/3, in each other direction with 1/9.

    Args:
        goal: the cell that pays 1 and ends the episode.
        start: the cell in which episodes begin; None: any but the goal, all as likely.
    """

    observation_space = gym.spaces.Discrete(len(PLACES))
    action_space = gym.spaces.Discrete(len(MOVES))

    def __init__(self, goal: int = G1, start: int | None = CORNER) -> None:
        self.goal, self.start = goal, start

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if self.start is None:
            drawn = int(self.np_random.integers(len(PLACES) - 1))
            self.cell = drawn + (drawn >= self.goal)
        else:
            self.cell = self.start
        return self.cell, {}

    def step(self, action: int) -> Any:
        drawn = int(self.np_random.integers(9))
        move = action if drawn < 6 else (action + drawn - 5) % 4
        self.cell = int(AFTER[self.cell, move])
        there = self.cell == self.goal
        return self.cell, float(there), there, False, {}


class ToHallway(Skill):
    """Leads from a room, or from its other hallway, to one of its two hallways by a shortest path.

    It stops wherever it leaves the room.
    """

    def __init__(self, name: str, room: Array, target: int, other: int) -> None:
        """Set ``room``: the cells inside, (104,) bool."""
        self.name, self.room = name, room
        self.starts = room.copy()
        self.starts[other] = True
        distance = np.full(len(PLACES), np.inf)
        distance[target] = 0.0
        for _ in PLACES:
            distance = np.where(room, 1.0 + distance[AFTER].min(1), distance)
        self.moves = distance[AFTER].argmin(1)

    def initiation(self, obs: Array) -> Array:
        return self.starts[obs]

    def termination(self, step: Any) -> Array:
        return ~self.room[step.next_obs]

    def policy(self, obs: Array) -> Array:
        return self.moves[obs]


class Move(Skill):
    """One move, as a skill of one step."""

    max_steps = 1

    def __init__(self, name: str, action: int) -> None:
        self.name, self.action = name, action

    def policy(self, obs: Array) -> Array:
        return np.full(len(obs), self.action)


def hallway_skills() -> list[Skill]:
    """Two for each of the four rooms."""
    row, column = np.array(PLACES).T
    rooms = {
        "upper_left": ((row < 6) & (column < 6), NORTH, WEST),
        "upper_right": ((row < 7) & (column > 6), NORTH, EAST),
        "lower_right": ((row > 7) & (column > 6), EAST, SOUTH),
        "lower_left": ((row > 6) & (column < 6), WEST, SOUTH),
    }
    names = {NORTH: "north", WEST: "west", EAST: "east", SOUTH: "south"}
    return [
        ToHallway(f"{where}_to_{names[target]}", room, target, other)
        for where, (room, *doors) in rooms.items()
        for target, other in (doors, doors[::-1])
    ]


def moves() -> list[Skill]:
    """Return the four moves of the environment as skills."""
    return [Move(name, action) for action, name in enumerate(MOVES)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30_000, help="training of the selector")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    hierarchy = Hierarchy(
        FourRooms,
        [*hallway_skills(), *moves()],
        call_steps=None,
        selector=DQN(learning_rate=0.01, gamma=0.9, network=Network(())),
        apart=Apart(selector_steps=asked.steps),
    )
    with tempfile.TemporaryDirectory() as folder:
        run = hierarchy.train(Path(folder) / "run", seed=asked.seed, quiet=True)
        steps = np.mean(run.evaluate(100).lengths)
    print(f"steps from the corner to the goal: {steps:.1f}")


if __name__ == "__main__":
    main()
