"""Steps per second on Ray, against RLlib's PPO with the same environment, network and collectors.

    pip install 'ray[rllib]'
    python -m benchmarks.rllib [--env CartPole-v1] [--rounds 5] [--steps 40000]

PPO on MiniGrid's DoorKey-8x8 in Python, or on the environment that ``--env`` names: two collectors
of 16 environments, rollouts of 128 steps, two separate networks of 64 and 64 units, 4 epochs,
batches of 1,024; the learner is in this process for both. RLlib's new API, with its defaults for
everything else. For RLlib the first update is not counted. The time in which collectors start is
not counted for either. Rounds take turns; the median ratio counts.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym

from benchmarks.collecting import BATCH, ENVS, EPOCHS, NETWORK, ROWS, grid, ours
from benchmarks.common import report
from skillweave.workers import Ray

COLLECTORS = 2


def rllib(steps: int, make: Callable[[], Any]) -> float:
    """Return steps per second of RLlib's PPO."""
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
    from ray.tune.registry import register_env

    register_env("measured", lambda _: make())
    config: Any = PPOConfig().environment("measured")
    model = DefaultModelConfig(
        fcnet_hiddens=list(NETWORK.hidden), fcnet_activation="tanh", vf_share_layers=False
    )
    config = (
        config.env_runners(
            num_env_runners=COLLECTORS,
            num_envs_per_env_runner=ENVS // COLLECTORS,
            rollout_fragment_length=ROWS,
        )
        .learners(num_learners=0)
        .rl_module(model_config=model)
        .training(train_batch_size=ENVS * ROWS, minibatch_size=BATCH, num_epochs=EPOCHS)
        .reporting(min_time_s_per_iteration=0)
    )
    algorithm = config.build_algo()
    begun = algorithm.train()["num_env_steps_sampled_lifetime"]
    made, started = begun, time.perf_counter()
    while made - begun < steps:
        made = algorithm.train()["num_env_steps_sampled_lifetime"]
    speed = (made - begun) / (time.perf_counter() - started)
    algorithm.stop()
    return float(speed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--env", help="a Gymnasium id; without it MiniGrid's DoorKey-8x8")
    given = parser.parse_args()
    make = partial(gym.make, given.env) if given.env else grid
    # Ray's processes would else be behind all others on a busy machine, and those here are not.
    os.environ.setdefault("RAY_worker_niceness", "0")
    ratios = []
    with Ray().joined(COLLECTORS):
        for _ in range(given.rounds):
            mine = ours(COLLECTORS, given.steps, Ray(COLLECTORS), given.env or grid)
            theirs = rllib(given.steps, make)
            ratios.append(mine / theirs)
            print(f"Skillweave {mine:,.0f}, RLlib {theirs:,.0f} steps/s: {ratios[-1]:.2f}")
    report("rllib", {"ratios": ratios, "median": statistics.median(ratios)})


if __name__ == "__main__":
    main()
