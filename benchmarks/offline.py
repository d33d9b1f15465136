"""Learning from data alone: CQL and IQL beside cloning, on data of mixed quality.

    python -m benchmarks.offline [cartpole lander maze …] [--seeds 5 6] [--online]

Each seed has its own data and its own networks. Episodes of the data are played by a controller
that acts at random in a share of the steps, which each episode draws: 0, 0.2, 0.5 or 1. In the maze
(PointMaze_UMaze, a new goal in each episode) the controller rolls from cell to cell, and noise is
added to its forces. Scores are mean returns of 100 new episodes, with their standard error.
``--online`` trains IQL on in the environment, and reports the lowest evaluation after the switch.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import report, workers
from benchmarks.hindsight import CELLS, MAZE, robotics
from skillweave import CQL, IQL, PPO, Dataset, EnvSpec, train_agent
from skillweave.types import Array

EPISODES = 100
SHARES = (0.0, 0.2, 0.5, 1.0)
"""Shares of steps at random, of which an episode draws one."""
BUDGET = 10_000
"""Gradient steps."""
ONLINE = 25_000
"""Steps in the environment after the switch; evaluations each 5,000."""


def balance(env: Any, obs: Array) -> Any:
    """Balance the pole of CartPole."""
    return int(obs[2] + 0.5 * obs[3] > 0)


def land(env: Any, obs: Array) -> Any:
    """Land, by Gymnasium's own controller."""
    from gymnasium.envs.box2d.lunar_lander import heuristic

    controller: Any = heuristic
    return controller(env.unwrapped, obs)


def roll(env: Any, obs: dict[str, Array]) -> Any:
    """Roll to the goal of the maze, through the middles of its cells."""
    place, goal = obs["achieved_goal"], obs["desired_goal"]
    here, there = (int(np.linalg.norm(CELLS - x, axis=1).argmin()) for x in (place, goal))
    target = goal if here == there else CELLS[here + int(np.sign(there - here))]
    force = 5.0 * (target - place) - 2.0 * obs["observation"][2:]
    return force + env.unwrapped.np_random.normal(0.0, 0.5, 2)


@dataclass(frozen=True)
class Case:
    """An environment, and the controller that plays its data."""

    env: str
    controller: Callable[[Any, Any], Any]
    discrete: bool = True


CASES = {
    "cartpole": Case("CartPole-v1", balance),
    "lander": Case("LunarLander-v3", land),
    "maze": Case(MAZE, roll, discrete=False),
}


def make(env_id: str) -> gym.Env[Any, Any]:
    """Make an environment by its id."""
    return robotics(env_id) if env_id == MAZE else gym.make(env_id)


def played(case: Case, seed: int) -> Dataset:
    """Play the episodes of a data set."""
    env = make(case.env)
    rng = np.random.default_rng(seed)
    env.action_space.seed(seed)
    episodes = []
    for number in range(EPISODES):
        share = rng.choice(SHARES)
        obs, _ = env.reset(seed=100_000 * (seed + 1) + number)
        steps: list[Any] = []
        seen, over = [obs], False
        while not over:
            at_random = rng.random() < share
            action = env.action_space.sample() if at_random else case.controller(env, obs)
            if not case.discrete:
                action = np.clip(action, -1, 1).astype(np.float32)
            obs, reward, terminated, truncated, _ = env.step(action)
            seen.append(obs)
            steps.append((action, reward, terminated, truncated))
            over = terminated or truncated
        actions, rewards, terminations, truncations = map(np.array, zip(*steps, strict=True))
        episodes.append(
            {
                "observations": stacked(seen),
                "actions": actions,
                "rewards": rewards,
                "terminations": terminations,
                "truncations": truncations,
            }
        )
    env.close()
    return Dataset(episodes, spec_of(case), name=f"{EPISODES} episodes of {case.env}")


def stacked(seen: list[Any]) -> Any:
    """Return observations as one array, or as a dict of arrays."""
    if isinstance(seen[0], dict):
        return {key: np.stack([obs[key] for obs in seen]) for key in seen[0]}
    return np.stack(seen)


def spec_of(case: Case) -> EnvSpec:
    """Return the environment of a case."""
    return EnvSpec(make, kwargs={"env_id": case.env}, workers=1)


def score(name: str, seed: int, online: bool) -> dict[str, Any]:
    """Train by each algorithm from the same data; return scores by name, with standard errors."""
    case = CASES[name]
    data = played(case, seed)
    returns = data.returns
    found: dict[str, Any] = {
        "behaviour": [float(returns.mean()), float(returns.std() / len(returns) ** 0.5)]
    }
    # A clone that does not learn on: one update at a rate of nearly 0.
    kinds: dict[str, tuple[Any, int]] = {
        "cloned": (PPO(num_envs=4, n_steps=32, learning_rate=1e-9), 128),
        "IQL": (IQL(), BUDGET),
    }
    if case.discrete:
        kinds["CQL"] = CQL(), BUDGET
    if online:
        kinds = {"IQL": (IQL(online=ONLINE / (BUDGET + ONLINE)), BUDGET + ONLINE)}
    for kind, (algorithm, steps) in kinds.items():
        with tempfile.TemporaryDirectory() as folder:
            how: dict[str, Any] = {"eval_every": 5_000, "eval_episodes": 50} if online else {}
            run = train_agent(
                spec_of(case), algorithm, steps, Path(folder) / "run", data=data, seed=seed,
                quiet=True, **how,
            )  # fmt: skip
            evaluation = run.evaluate(EPISODES, seed=1_000 + seed, quiet=True)
            found[kind] = [evaluation.mean, float(np.std(evaluation.returns) / EPISODES**0.5)]
            if online:
                lines = (Path(folder) / "run" / "metrics.jsonl").read_text().splitlines()
                curve = [(x["steps"], x["eval_return"]) for x in map(json.loads, lines)
                         if "eval_return" in x]  # fmt: skip
                found["at the switch"] = max(x for x in curve if x[0] <= BUDGET)[1]
                found["lowest"] = min(value for steps, value in curve if steps > BUDGET)
    return {"case": name, "seed": seed, **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=[*CASES])
    parser.add_argument("--seeds", type=int, nargs="+", default=[5, 6, 7, 8, 9])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--online", action="store_true")
    asked = parser.parse_args()
    with workers(asked.processes) as pool:
        jobs = [
            pool.submit(score, name, seed, asked.online)
            for name in asked.cases
            for seed in asked.seeds
        ]
        scores = []
        for job in jobs:
            scores.append(job.result())
            print(scores[-1], flush=True)
    medians = {}
    for name in asked.cases:
        mine = [x for x in scores if x["case"] == name]
        for kind in [k for k in mine[0] if isinstance(mine[0][k], list)]:
            values = sorted(x[kind][0] for x in mine)
            medians[f"{name}: {kind}"] = [values[len(values) // 2], values[0]]
    report("offline", {"scores": scores, "median and worst": medians})


if __name__ == "__main__":
    main()
