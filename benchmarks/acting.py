"""Acting on one observation at a time, as a deployed policy does, against Stable-Baselines3.

    python -m benchmarks.acting [--rounds 5] [--steps 2000]

The networks are untrained and all of the same size. A ratio is the median over rounds of a
policy's actions per second, divided by those of Stable-Baselines3's ``predict`` in the same round.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import skillweave as sw
from benchmarks.common import median, report, table
from skillweave.algorithms.policy import AgentPolicy, make_algorithm
from skillweave.collecting.skill_set import SkillSet
from skillweave.seeding import Seeds

ENV = "CartPole-v1"
NETWORK = sw.Network((64, 64))


class Left(sw.Skill):
    """Ends by itself."""

    def termination(self, step: sw.Step) -> sw.Array:
        ended: sw.Array = step.next_obs[:, 0] < -0.1
        return ended


class Right(sw.Skill):
    """May start only in some places."""

    def initiation(self, obs: sw.Array) -> sw.Array:
        may: sw.Array = obs[:, 0] < 1.0
        return may


class Center(sw.Skill):
    """Lasts as long as calls do."""


class Inner(sw.Skill):
    """A hierarchy of the others."""


def network(observations: Any, actions: Any, seed: int) -> AgentPolicy:
    """Return an untrained policy."""
    algorithm = make_algorithm(sw.PPO(network=NETWORK), observations, actions)
    return AgentPolicy.of(algorithm, algorithm.init([Seeds(seed)]))


def policies() -> dict[str, Any]:
    """Return a flat policy, one over three skills, and one over a hierarchy of these."""
    env = gym.make(ENV)
    seen, taken = env.observation_space, env.action_space
    skills = (Left(), Right(), Center())
    act = tuple(network(seen, taken, i) for i in range(3))
    selector = network(seen, gym.spaces.Discrete(3), 3)
    inner = sw.HierarchyPolicy(selector, SkillSet(skills, act, call_steps=20))
    over = SkillSet((Inner(), Center()), (inner, act[2]), call_steps=40)
    nested = sw.HierarchyPolicy(network(seen, gym.spaces.Discrete(2), 4), over)
    return {"flat": act[0], "hierarchy": inner, "nested": nested}


def acts_per_second(policy: Any, steps: int) -> float:
    """Play episodes with a player; only acting is timed."""
    env, player, seconds = gym.make(ENV), sw.Player(policy), 0.0
    obs, info = env.reset(seed=0)
    for _ in range(steps):
        before = time.perf_counter()
        action = player.act(obs, info=info)
        seconds += time.perf_counter() - before
        obs, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            obs, info = env.reset()
            player.reset()
    return steps / seconds


def stable_baselines3(steps: int) -> float:
    """Do the same with a PPO of Stable-Baselines3."""
    import stable_baselines3 as sb3

    env = gym.make(ENV)
    model = sb3.PPO("MlpPolicy", env, device="cpu", policy_kwargs={"net_arch": [64, 64]})
    obs, _ = env.reset(seed=0)
    seconds = 0.0
    for _ in range(steps):
        before = time.perf_counter()
        action, _ = model.predict(obs, deterministic=True)
        seconds += time.perf_counter() - before
        obs, _, terminated, truncated, _ = env.step(int(np.asarray(action)))
        if terminated or truncated:
            obs, _ = env.reset()
    return steps / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=2_000)
    given = parser.parse_args()
    torch.set_num_threads(1)
    made = policies()
    speeds: dict[str, list[float]] = {name: [] for name in ("Stable-Baselines3", *made)}
    for _ in range(given.rounds):
        speeds["Stable-Baselines3"].append(stable_baselines3(given.steps))
        for name, policy in made.items():
            speeds[name].append(acts_per_second(policy, given.steps))
    baseline = speeds["Stable-Baselines3"]
    ratios = {
        name: median(a / b for a, b in zip(own, baseline, strict=True))
        for name, own in speeds.items()
    }
    rows = [[name, f"{median(own):,.0f}", f"{ratios[name]:.2f}"] for name, own in speeds.items()]
    print(table(["policy", "actions per second", "ratio"], rows))
    report(
        "acting", {"actions per second": {k: median(v) for k, v in speeds.items()}, "ratio": ratios}
    )


if __name__ == "__main__":
    main()
