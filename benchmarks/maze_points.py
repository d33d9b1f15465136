"""The large maze with one skill with a goal: roll to a point that is near; a selector chooses it.

    python -m benchmarks.maze_points [--seeds 0 1] [--out runs/maze-points]

The recipe ``mazes`` with one skill in place of its five, in as many steps: a million for the skill
and the selector together. Points are the middles of the maze's cells. The selector chooses any; the
skill rolls to the cell in this direction that is two columns and two rows away at most. Neither
sees walls. A score is the share of 60 episodes of Gymnasium-Robotics' maze that reach the goal,
where the selector samples.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import Apart, Hierarchy, Network, Skill, Step
from skillweave.algorithms import register_encoder
from skillweave.recipes import _mazes, mazes
from skillweave.recipes._mazes import PLACE, SPEED
from skillweave.types import Array

SKILL_STEPS, SELECTOR_STEPS = 40_000, 948_000
"""Together they are the recipe's, a million."""
EPISODES = 60
RANGE = 2
"""Columns and rows to the furthest point of a call."""
THERE = 0.3
"""Metres from the point at which a call ends."""
GAIN = 0.02
"""Metres a second that a ball gains in each step if no wall is in its way. The recipe's skills push
as hard as they can; this one also steers, so it gains less."""
CELLS = np.array([12, 9])
"""Columns and rows of the maze, from its south-western corner."""


def middle(cell: Array) -> Array:
    """Return metres east and north of the middles of cells, (n, 2)."""
    metres: Array = cell + 0.5 - CELLS / 2
    return metres


def cell_of(obs: Array) -> Array:
    """Return the column and the row of the ball, (n, 2)."""
    cell: Array = np.floor(obs[:, PLACE] + CELLS / 2).astype(np.int64)
    return cell


class GoTo(Skill):
    """Roll to a point, until it is there, or a wall is in the way."""

    goal_space = gym.spaces.MultiDiscrete(CELLS)
    max_steps = 100
    steps = SKILL_STEPS

    def goals(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return cells in range."""
        inner: Array = np.clip(
            cell_of(obs) + rng.integers(-RANGE, RANGE + 1, (len(obs), 2)), 0, CELLS - 1
        )
        return inner

    def clip_goal(self, obs: Array, goal: Array) -> Array:
        """Return the cells in range that are nearest to the chosen ones."""
        here = cell_of(obs)
        near: Array = np.clip(goal, here - RANGE, here + RANGE)
        return near

    def reward(self, step: Step) -> Array:
        """Return metres a second by which the point comes nearer."""
        nearer: Array = 100.0 * (self.far(step.obs, step.goal) - self.far(step.next_obs, step.goal))
        return nearer

    def far(self, obs: Array, goal: Any) -> Array:
        """Return metres to the point, (n,)."""
        metres: Array = np.hypot(*(middle(goal) - obs[:, PLACE]).T)
        return metres

    def termination(self, step: Step) -> Array:
        """Return whether it is there, or stuck as the recipe's skills are."""
        way = middle(step.goal) - step.next_obs[:, PLACE]
        way = way / np.maximum(np.hypot(*way.T), 1e-6)[:, None]
        before, after = ((o[:, SPEED] * way).sum(axis=1) for o in (step.obs, step.next_obs))
        stuck = (after < mazes.SLOW) & (after - before < GAIN) & (step.elapsed >= mazes.TRY)
        ends: Array = stuck | self.success(step)
        return ends

    def success(self, step: Step) -> Array:
        """Return whether it is there."""
        there: Array = self.far(step.next_obs, step.goal) < THERE
        return there


class Motion(mazes.Motion):
    """An encoder without parameters: the speed, and where the point is from here."""

    def __call__(self, views: Any, inputs: Mapping[str, Any]) -> Any:
        """Map (P, B, 6 + 12 + 9) to (P, B, 4): the cell's column and row are one-hot."""
        import torch

        seen = inputs["vector"]
        hot = torch.split(seen[..., 6:], CELLS.tolist(), -1)
        cell = torch.stack([one.argmax(-1) for one in hot], -1)
        point = cell + 0.5 - torch.as_tensor(CELLS) / 2
        return torch.cat([seen[..., SPEED], point - seen[..., PLACE]], -1)


register_encoder("motion to a point in a maze", Motion)


def declare(**how: Any) -> Hierarchy:
    """Return the hierarchy; ``how`` changes any of its settings."""
    network = Network(hidden=(32, 32), activation="relu", encoder="motion to a point in a maze")
    settings: dict[str, Any] = {
        "call_steps": 25,
        "algorithm": replace(mazes.BALL, network=network),
        "selector": mazes.SELECTOR,
        "learn": "apart",
        "apart": Apart(selector_steps=SELECTOR_STEPS),
        "selection": mazes.SAMPLING,
    } | how
    return Hierarchy(_mazes.spec("large"), [GoTo()], **settings)


def score(seed: int, out: Path) -> float:
    """Return the share of episodes that reach the goal; train what is not in the folder."""
    hierarchy, path = declare(), out / str(seed)
    run = hierarchy.resume(path) if path.exists() else hierarchy.train(path, seed=seed)
    return float(run.evaluate(EPISODES, deterministic=False).mean)


def main() -> None:
    """Train each seed, and print its score."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--out", type=Path, default=Path("runs/maze-points"))
    asked = parser.parse_args()
    scores = []
    for seed in asked.seeds:
        start = time.perf_counter()
        scores.append(score(seed, asked.out))
        print(f"seed {seed}: {scores[-1]:.0%}, {time.perf_counter() - start:.0f} s", flush=True)
    print(f"median {statistics.median(scores):.0%}")


if __name__ == "__main__":
    main()
