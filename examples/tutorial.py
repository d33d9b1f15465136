"""The job of AgileRL's hierarchical-skills tutorial in the native API: train, score, film.

    pip install 'skillweave[box2d,video]'
    python examples/tutorial.py --scale 1 --out runs/tutorial

docs/from-agilerl.md puts the old lines and the new ones side by side. The shipped recipe
``lunar-lander`` has the same skills with budgets that make them land.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from skillweave import (
    PPO,
    Apart,
    Hierarchy,
    Reflex,
    Skill,
)

X, Y, ANGLE = 0, 1, 4


def movement(step, *columns):
    """Return ``Σ (10·Δ)²`` over the columns; 0 on the first step, which has no step before it."""
    moved = 10.0 * (step.next_obs[:, columns] - step.obs[:, columns])
    return np.where(step.elapsed > 1, np.square(moved).sum(axis=1), 0.0)


class Stabilize(Skill):
    max_steps = 300

    def reward(self, step):
        reward = 1.0 - movement(step, X, Y, ANGLE)
        return np.where(step.terminated | step.truncated, -100.0, reward)


class Center(Skill):
    max_steps = 300

    def reward(self, step):
        reward = 1.0 - np.square(2.0 * step.next_obs[:, X]) - movement(step, Y, ANGLE)
        return np.where(step.terminated | step.truncated, -1000.0, reward)


class Landing(Skill):
    def reward(self, step):
        obs = step.next_obs
        reward = 1.0 - np.square(obs[:, (X, Y)]).sum(axis=1) - np.abs(obs[:, ANGLE])
        return np.where(step.terminated | step.truncated, step.reward, reward)


def landed(obs):
    return (obs[:, 6] > 0) | (obs[:, 7] > 0)


hierarchy = Hierarchy(
    env="LunarLander-v3",
    skills=[Stabilize(), Center(), Landing()],
    call_steps=40,
    reflexes=[Reflex(landed, action=0, name="engines off")],
    algorithm=PPO(
        num_envs=64,
        n_steps=64,
        batch_size=256,
        update_epochs=4,
        learning_rate=1e-3,
        gamma=0.99,
        gae_lambda=0.95,
    ),
    apart=Apart(skill_steps=500_000, selector_steps=1_000_000),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", type=float, default=1.0, help="multiplies every budget")
    parser.add_argument("--episodes", type=int, default=100, help="of the evaluation")
    parser.add_argument("--out", type=Path, default=Path("runs/tutorial"))
    given = parser.parse_args()
    hierarchy.scale(given.scale)
    run = hierarchy.train(given.out, seed=0, quiet=True)
    print(f"the hierarchy: {run.evaluate(given.episodes)}")
    for name in ("stabilize", "center", "landing"):
        run.render(given.out / f"{name}.gif", skill=name, max_steps=300)
    film = run.render(given.out / "selector.gif", max_steps=1000)
    print(f"filmed {film['path']}")


if __name__ == "__main__":
    main()
