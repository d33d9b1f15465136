"""Button, gate, flag: three skills with continuous actions that learn together, from nothing.

    python examples/yard.py

A sledge in a yard with a wall across it. A button opens the gate in the wall, and the reward is
paid at the flag behind it alone. All settings are the library's defaults. It needs no extra.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw
from skillweave.types import Array

BUTTON = np.array([-0.8, 0.8])
FLAG = np.array([0.8, -0.8])
NEAR = 0.12
GATE = 0.15
"""Half the gate's width; it is in the middle of the wall, at x = 0."""
OPEN, BEHIND = 4, 5
LONGEST = 300


class Yard(gym.Env[np.ndarray, np.ndarray]):
    """Observations: place and speed, (x, y) each; whether the gate is open; whether it is behind
    the wall. Actions push the sledge, (x, y).
    """

    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = self.np_random.uniform((-1.0, -1.0), (-0.5, 1.0))
        self.speed = np.zeros(2)
        self.open, self.steps = False, 0
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.speed = 0.8 * self.speed + 0.02 * np.clip(action, -1.0, 1.0)
        place = np.clip(self.place + self.speed, -1.0, 1.0)
        through = self.open and abs(place[1]) < GATE
        if (place[0] > 0.0) != (self.place[0] > 0.0) and not through:
            place[0], self.speed[0] = self.place[0], 0.0
        self.place = place
        self.open = self.open or near(place, BUTTON)
        won = near(place, FLAG)
        return self._seen(), float(won), won, self.steps >= LONGEST, {}

    def _seen(self) -> np.ndarray:
        seen = [*self.place, *self.speed, self.open, self.place[0] > 0.0]
        return np.array(seen, np.float32)


def near(place: np.ndarray, point: np.ndarray) -> bool:
    """Return whether ``place`` is at ``point``."""
    return bool(np.hypot(*(place - point)) < NEAR)


class Change(sw.Skill):
    """Makes a flag of the observation 1, the one in column ``what``."""

    max_steps = 100
    what = OPEN

    def reward(self, step: sw.Step) -> Array:
        return step.next_obs[:, self.what] - step.obs[:, self.what]

    def termination(self, step: sw.Step) -> Array:
        return step.next_obs[:, self.what] == 1

    def success(self, step: sw.Step) -> Array:
        return self.termination(step)


class Press(Change):
    """Goes to the button, which opens the gate."""

    def initiation(self, obs: Array) -> Array:
        return obs[:, OPEN] == 0


class Pass(Change):
    """Goes through the gate."""

    what = BEHIND

    def initiation(self, obs: Array) -> Array:
        return (obs[:, OPEN] == 1) & (obs[:, BEHIND] == 0)


class Reach(sw.Skill):
    """Reaches the flag."""

    max_steps = 100

    def initiation(self, obs: Array) -> Array:
        return obs[:, BEHIND] == 1

    def reward(self, step: sw.Step) -> Array:
        return step.reward

    def success(self, step: sw.Step) -> Array:
        return step.terminated


def algorithm(**how: Any) -> sw.PPO:
    """Return the learner's settings."""
    settings: dict[str, Any] = {
        "num_envs": 64,
        "n_steps": 64,
        "batch_size": 256,
        "update_epochs": 10,
        "learning_rate": 1e-3,
    }
    return sw.PPO(**settings | how)


def declare(steps: int = 300_000, workers: int | None = None, **how: Any) -> sw.Hierarchy:
    """Return the hierarchy; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "steps": steps,
        "together": sw.Together(task_weight=0.0),
        "algorithm": algorithm(),
        "selector": algorithm(),
    } | how
    env = sw.EnvSpec(Yard, workers=workers)
    return sw.Hierarchy(env, [Press(), Pass(), Reach()], **settings)


hierarchy = declare()


def main() -> None:
    """Train it, and say how many episodes it solves."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="how many episodes score it")
    parser.add_argument("--out", default="runs/yard")
    asked = parser.parse_args()
    run = declare(steps=asked.steps).train(asked.out, seed=asked.seed)
    found = run.evaluate(asked.episodes)
    print(found.for_people())
    print(f"solved: {found.mean:.0%} of the episodes")


if __name__ == "__main__":
    main()
