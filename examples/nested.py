"""Two errands: a hierarchy of two hierarchies that learn together, from nothing.

    python examples/nested.py

A letter is to be brought to its box, and a parcel to its depot. Each errand is a hierarchy (fetch,
deliver) with a selector of its own; the hierarchy above decides which errand goes on. All of them,
two levels of selectors and four skills, learn from the same steps.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import skillweave as sw
from skillweave.types import Array

SIZE = 6
WAITING, CARRIED, DELIVERED = 0.0, 0.5, 1.0
MOVES = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])
ERRANDS = {"letters": 0, "parcels": 1}


class Errands(gym.Env[Any, Any]):
    """A square of cells; the letter, the parcel and their aims lie anywhere.

    Observations are where the agent is, then for each errand where its thing lies, where it is to
    be brought, and how far it is. What lies in a cell is picked up there, one thing at a time.
    """

    observation_space = gym.spaces.Box(0.0, 1.0, (12,), np.float32)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        cells = self.np_random.permutation(SIZE * SIZE)[:5]
        self.agent, *places = (np.array(divmod(int(cell), SIZE)) for cell in cells)
        self.places = np.array(places)
        self.state = np.full(2, WAITING)
        self.left = 80
        return self._seen(), {}

    def step(self, action: int) -> Any:
        self.agent = np.clip(self.agent + MOVES[action], 0, SIZE - 1)
        paid = 0.0
        for k in (0, 1):
            there = (self.places[2 * k : 2 * k + 2] == self.agent).all(1)
            if self.state[k] == WAITING and there[0] and CARRIED not in self.state:
                self.state[k] = CARRIED
            elif self.state[k] == CARRIED and there[1]:
                self.state[k], paid = DELIVERED, paid + 1.0
        self.left -= 1
        done = bool((self.state == DELIVERED).all())
        return self._seen(), paid - 0.01, done, self.left == 0 and not done, {"success": done}

    def _seen(self) -> Array:
        rows = [np.append(self.places[2 * k : 2 * k + 2] / SIZE, self.state[k]) for k in (0, 1)]
        return np.concatenate([self.agent / SIZE, *rows]).astype(np.float32)


class OfErrand(sw.Skill):
    """A base of both skills of an errand: it holds the errand."""

    def __init__(self, errand: str) -> None:
        self.column = 6 + 5 * ERRANDS[errand]

    def state(self, obs: Array) -> Array:
        """(N,), how far the errand is."""
        return obs[:, self.column]


class Fetch(OfErrand):
    """Picks the thing up; nothing is left to do once it is delivered."""

    max_steps = 30

    def initiation(self, obs: Array) -> Array:
        return self.state(obs) < DELIVERED

    def reward(self, step: sw.Step) -> Array:
        return (self.state(step.next_obs) > self.state(step.obs)) - 0.02

    def termination(self, step: sw.Step) -> Array:
        return self.state(step.next_obs) >= CARRIED


class Deliver(OfErrand):
    """Brings it where it belongs."""

    max_steps = 30

    def initiation(self, obs: Array) -> Array:
        return self.state(obs) == CARRIED

    def reward(self, step: sw.Step) -> Array:
        return (self.state(step.next_obs) > self.state(step.obs)) - 0.02

    def termination(self, step: sw.Step) -> Array:
        return self.state(step.next_obs) == DELIVERED


def declare(steps: int = 150_000, **how: Any) -> sw.Hierarchy:
    """Return the hierarchy of both errands; ``how`` changes any setting of the upper one."""
    env = sw.EnvSpec(Errands, workers=1)
    learner = sw.PPO(
        num_envs=16,
        n_steps=128,
        batch_size=256,
        update_epochs=4,
        learning_rate=1e-3,
        gamma=0.97,
        gae_lambda=0.98,
        network=sw.Network(hidden=(64, 64)),
    )
    selection = sw.Selection(deliberation_cost=0.01, greedy_skills=False)
    settings: dict[str, Any] = {"algorithm": learner, "selector": learner, "selection": selection}
    errands: list[Any] = [
        sw.Hierarchy(env, [Fetch(name), Deliver(name)], call_steps=30, name=name, **settings)
        for name in ERRANDS
    ]
    above: dict[str, Any] = {"call_steps": 40, "steps": steps} | settings
    above["together"] = sw.Together(task_weight=0.0, epsilon=0.5, epsilon_final=0.05)
    return sw.Hierarchy(env, errands, **above | how)


hierarchy = declare()


def main() -> None:
    """Train it, and say how many episodes it solves."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="runs/nested")
    asked = parser.parse_args()
    run = declare(asked.steps).train(asked.out, seed=asked.seed)
    found = run.evaluate(100)
    print(found.for_people())
    print(f"both errands done: {np.mean(np.array(found.returns) > 1):.0%} of the episodes")


if __name__ == "__main__":
    main()
