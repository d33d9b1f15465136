"""Axe, wood, bridge, far bank: four skills and a selector that learn together, from nothing.

    python examples/bridge.py

A grid of 13 by 9 cells with a river. An agent with the axe can fell the tree, an agent with the
wood can build a bridge at the river, and the reward is paid on the other side alone. It needs no
extra.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw
from skillweave.types import Array

WIDTH, HEIGHT, RIVER, LONGEST = 13, 9, 8, 80
X, Y, AXE, WOOD, BRIDGE = range(5)
MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1))
WORK = len(MOVES)
"""The action that takes, fells or builds, whatever can be done where the agent stands."""


class River(gym.Env[np.ndarray, np.int64]):
    """Observations: the agent's cell; whether it has the axe, has wood, and the bridge stands; the
    cells of axe and tree; the bridge's row, -1 before there is one.
    """

    action_space = gym.spaces.Discrete(5)
    observation_space = gym.spaces.Box(-1.0, 13.0, (10,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        cells = self.np_random.permutation(RIVER * HEIGHT)[:3]
        self.me, self.axe, self.tree = [divmod(int(cell), HEIGHT) for cell in cells]
        self.has_axe = self.has_wood = False
        self.bridge: int | None = None
        self.steps = 0
        return self._seen(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        if action == WORK:
            self._work()
        else:
            self._move(*MOVES[action])
        crossed = self.me[0] == WIDTH - 1
        return self._seen(), float(crossed), crossed, self.steps >= LONGEST, {}

    def _move(self, dx: int, dy: int) -> None:
        x = min(max(self.me[0] + dx, 0), WIDTH - 1)
        y = min(max(self.me[1] + dy, 0), HEIGHT - 1)
        if x != RIVER or y == self.bridge:
            self.me = x, y

    def _work(self) -> None:
        x, y = self.me
        if not self.has_axe:
            self.has_axe = self.me == self.axe
        elif self.has_wood:
            self.has_wood = False  # anywhere but at the river it is lost
            if x == RIVER - 1:
                self.bridge = y
        elif self.bridge is None:
            self.has_wood = self.me == self.tree

    def _seen(self) -> np.ndarray:
        built = self.bridge is not None
        numbers = [*self.me, self.has_axe, self.has_wood, built, *self.axe, *self.tree]
        return np.array([*numbers, -1 if self.bridge is None else self.bridge], np.float32)


class Get(sw.Skill):
    """Gets the thing whose flag in the observation is ``what``."""

    max_steps = 20
    what = AXE

    def reward(self, step: sw.Step) -> Array:
        return (step.next_obs[:, self.what] > step.obs[:, self.what]) - 0.02

    def termination(self, step: sw.Step) -> Array:
        return step.next_obs[:, self.what] == 1

    def success(self, step: sw.Step) -> Array:
        return self.termination(step)


class GetAxe(Get):
    """Fetches the axe."""

    def initiation(self, obs: Array) -> Array:
        return obs[:, AXE] == 0


class Chop(Get):
    """Fells the tree."""

    what = WOOD

    def initiation(self, obs: Array) -> Array:
        return (obs[:, AXE] == 1) & (obs[:, WOOD] == 0) & (obs[:, BRIDGE] == 0)


class Build(Get):
    """Carries the wood to the river and builds the bridge."""

    what = BRIDGE

    def initiation(self, obs: Array) -> Array:
        return obs[:, WOOD] == 1


class Cross(sw.Skill):
    """Reach the far bank. It may start anywhere: the selector must learn when it is of use."""

    max_steps = 20

    def reward(self, step: sw.Step) -> Array:
        return (step.next_obs[:, X] == WIDTH - 1) - 0.02

    def termination(self, step: sw.Step) -> Array:
        return step.next_obs[:, X] == WIDTH - 1

    def success(self, step: sw.Step) -> Array:
        return self.termination(step)


def algorithm(**how: Any) -> sw.PPO:
    """Return the learner's settings."""
    settings: dict[str, Any] = {
        "num_envs": 16,
        "n_steps": 64,
        "batch_size": 256,
        "update_epochs": 10,
        "gamma": 0.97,
        "learning_rate": 1e-3,
    }
    return sw.PPO(**settings | how)


def declare(steps: int = 500_000, workers: int | None = None, **how: Any) -> sw.Hierarchy:
    """Return the hierarchy; ``how`` changes any of its settings."""
    settings = {
        "call_steps": None,  # a call lasts until its skill stops
        "steps": steps,
        "together": sw.Together(task_weight=0.0),
        "algorithm": algorithm(),
        "selector": algorithm(),
    } | how
    env = sw.EnvSpec(River, workers=workers)
    return sw.Hierarchy(env, [GetAxe(), Chop(), Build(), Cross()], **settings)


hierarchy = declare()


def main() -> None:
    """Train it, and say how many episodes it solves."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=500_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="runs/bridge")
    asked = parser.parse_args()
    run = declare(steps=asked.steps).train(asked.out, seed=asked.seed)
    found = run.evaluate(100)
    print(found.for_people())
    print(f"solved: {found.mean:.0%} of the episodes")


if __name__ == "__main__":
    main()
