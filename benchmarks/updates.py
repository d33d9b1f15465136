"""One PPO update of P members in a stack against the same updates one by one; and compiled against
plain (``compile=True``, after it was compiled). All in the same run."""

from __future__ import annotations

import time

import gymnasium as gym
import numpy as np
import torch

from benchmarks.common import report, table
from skillweave import PPO, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Rollout
from skillweave.algorithms.ppo import PPOAlgorithm


def rollout(members: int, samples: int) -> Rollout:
    g = torch.Generator().manual_seed(0)
    lead = (members, samples, 1)
    obs, ends = (torch.randn(*lead, 8, generator=g) for _ in range(2))
    last = torch.rand(lead, generator=g) < 0.05
    last[:, -1] = True
    # What follows is the next row, except at ends.
    following = torch.where(last[..., None], ends, obs.roll(-1, dims=1))
    return Rollout(
        obs=obs,
        action=torch.randint(0, 4, lead, generator=g),
        reward=torch.randn(lead, generator=g),
        discount=torch.full(lead, 0.99),
        next_obs=following,
        last=last,
        dist_params=torch.randn(*lead, 4, generator=g),
    )


def seconds(
    members: int, samples: int, repeats: int, batch: int | None = None, compile: bool = False
) -> float:
    space = gym.spaces.Box(-np.inf, np.inf, (8,))
    config = PPO(
        num_envs=1,
        n_steps=samples,
        batch_size=batch or samples,
        update_epochs=4,
        network=Network(activation="relu"),
        compile=compile,
    )
    algorithm = PPOAlgorithm(config, space, gym.spaces.Discrete(4))
    seeds = [Seeds(0) / m for m in range(members)]
    state, data = algorithm.init(seeds), rollout(members, samples)
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        algorithm.update(state, data, [s.torch() for s in seeds])
        times.append(time.perf_counter() - started)
    return float(np.median(times))


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for samples in (64, 256, 1024):
        one = seconds(1, samples, 20)
        for members in (1, 8, 16):
            together = seconds(members, samples, 20)
            ratio = together / (one * members)
            rows.append([members, samples, f"{1e3 * together:.2f}", f"{ratio:.2f}"])
    header = ["members", "samples", "ms a stacked update", "÷ one by one"]
    print(table(header, rows))
    compiled = []
    for batch in (64, 256, 1024):
        plain, fused = (seconds(1, 4096, 20, batch, compile) for compile in (False, True))
        times = (f"{1e3 * t:.0f}" for t in (plain, fused))
        compiled.append([batch, *times, f"{fused / plain:.2f}"])
    header = ["samples of a minibatch", "ms an update from 4,096 samples", "ms compiled", "÷ plain"]
    print(table(header, compiled))
    report("updates", {"rows": rows, "compiled": compiled})


if __name__ == "__main__":
    main()
