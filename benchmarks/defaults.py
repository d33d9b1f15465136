"""The algorithms with nothing but their defaults, beside Stable-Baselines3 with tuned settings.

    python -m benchmarks.defaults [ppo dqn sac td3] [--only Hopper-v5 …] [--seeds 0 1 2] [--compile]

The reference is rl-zoo3's table of trained agents (``benchmark.md`` in its repository): settings
tuned for each environment, one run each, scored after training. Its MuJoCo environments are of
version 3, those here of version 5; LunarLander is v2 there, v3 here. Both scores are measured from
a random policy's: 1 is as good as the reference. Budgets are those of the table, at most 1M steps
for PPO and 300,000 for the others.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import median, report, table, workers
from benchmarks.learning import scored
from skillweave import DQN, PPO, SAC, TD3, EnvSpec

ALGORITHMS: dict[str, Any] = {"ppo": PPO(), "dqn": DQN(), "sac": SAC(), "td3": TD3()}
EPISODES = 50


@dataclass(frozen=True)
class Case:
    """An algorithm on an environment, and what the reference scores there."""

    algorithm: str
    env: str
    steps: int
    reference: float


CASES = (
    Case("ppo", "CartPole-v1", 100_000, 500.0),
    Case("ppo", "Acrobot-v1", 1_000_000, -73.5),
    Case("ppo", "MountainCar-v0", 1_000_000, -110.4),
    Case("ppo", "Pendulum-v1", 100_000, -172.2),
    Case("ppo", "LunarLander-v3", 1_000_000, 242.1),
    Case("ppo", "LunarLanderContinuous-v3", 1_000_000, 270.9),
    Case("ppo", "HalfCheetah-v5", 1_000_000, 5_819.1),
    Case("ppo", "Hopper-v5", 1_000_000, 2_410.4),
    Case("ppo", "Walker2d-v5", 1_000_000, 3_478.8),
    Case("ppo", "Swimmer-v5", 1_000_000, 281.6),
    Case("dqn", "CartPole-v1", 50_000, 500.0),
    Case("dqn", "Acrobot-v1", 100_000, -76.6),
    Case("dqn", "LunarLander-v3", 100_000, 154.4),
    Case("sac", "Pendulum-v1", 20_000, -157.0),
    Case("sac", "MountainCarContinuous-v0", 50_000, 94.7),
    Case("sac", "LunarLanderContinuous-v3", 300_000, 260.4),  # the reference took 500,000
    Case("td3", "Pendulum-v1", 20_000, -151.9),
    Case("td3", "MountainCarContinuous-v0", 300_000, 93.5),
    Case("td3", "LunarLanderContinuous-v3", 300_000, 207.5),
)


def at_random(name: str) -> float:
    """Return the mean return of a random policy."""
    env = gym.make(name)
    env.action_space.seed(0)
    returns = []
    for episode in range(EPISODES):
        env.reset(seed=episode)
        total, over = 0.0, False
        while not over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    return float(np.mean(returns))


def learn(case: Case, seed: int, compile: bool) -> dict[str, Any]:
    """Train once; return the score on Gymnasium's environment with seeds new to training."""
    algorithm = ALGORITHMS[case.algorithm]
    found, seconds = scored(EnvSpec(case.env), algorithm, case.steps, seed, EPISODES, compile)
    score, chance = found.mean, at_random(case.env)
    share = (score - chance) / (case.reference - chance)
    return {
        "algorithm": case.algorithm,
        "env": case.env,
        "steps": case.steps,
        "seed": seed,
        "score": round(score, 1),
        "random": round(chance, 1),
        "reference": case.reference,
        "share": round(share, 2),
        "seconds": round(seconds),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("algorithms", nargs="*", choices=[*ALGORITHMS, []], default=[*ALGORITHMS])
    parser.add_argument("--only", nargs="+", help="environments")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--compile", action="store_true", help="as of benchmarks.learning")
    given = parser.parse_args()
    wanted = [c for c in CASES if c.algorithm in given.algorithms]
    wanted = [c for c in wanted if not given.only or c.env in given.only]
    rows: list[dict[str, Any]] = []
    with workers(given.processes) as pool:
        jobs = [pool.submit(learn, c, seed, given.compile) for c in wanted for seed in given.seeds]
        for job in jobs:
            rows.append(job.result())
            print(rows[-1], flush=True)
    print(table(list(rows[0]), [list(r.values()) for r in rows]))
    shares = {
        f"{c.algorithm} {c.env}": median(
            r["share"] for r in rows if (r["algorithm"], r["env"]) == (c.algorithm, c.env)
        )
        for c in wanted
    }
    mean, worst = float(np.mean(list(shares.values()))), min(shares.values())
    report("defaults", {"mean": mean, "worst": worst, "shares": shares, "rows": rows})


if __name__ == "__main__":
    main()
