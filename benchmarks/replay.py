"""The replay store: bytes and speed with a million LunarLander transitions, against SB3's.

    python -m benchmarks.replay [--transitions 1000000]

Random episodes of 200 steps on average stand in for LunarLander's; each store is measured in a
process of its own, so that the growth of the resident memory is its own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import median, report, table, workers

NUM_ENVS, BATCH, PRIORITIZED_BATCH, REPEATS = 16, 256, 128, 2000
SPACE = gym.spaces.Box(-np.inf, np.inf, (8,), np.float32)
MB = 1e6


def resident() -> float:
    """MB that the process holds in memory (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / MB


def microseconds(call: Callable[[], Any]) -> float:
    """Median over rounds of the mean time of a call."""
    rounds = []
    for _ in range(10):
        started = time.perf_counter()
        for _ in range(REPEATS // 10):
            call()
        rounds.append((time.perf_counter() - started) / (REPEATS // 10) * 1e6)
    return median(rounds)


def filled(transitions: int, add: Callable[..., None]) -> float:
    """Fill a buffer with random steps; transitions/s."""
    rng = np.random.default_rng(0)
    obs, true = rng.random((2, NUM_ENVS, 8), dtype=np.float32)
    reward, action = rng.random(NUM_ENVS, dtype=np.float32), rng.integers(4, size=NUM_ENVS)
    rows = transitions // NUM_ENVS
    ends = rng.random((rows, NUM_ENVS)) < 1 / 200
    started = time.perf_counter()
    for ended in ends:
        add(obs, true, action, reward, ended)
    return rows * NUM_ENVS / (time.perf_counter() - started)


def ours(transitions: int, **kwargs: Any) -> dict[str, float]:
    import torch

    from skillweave.algorithms.batches import Batch
    from skillweave.buffers.replay import ReplayStore

    torch.set_num_threads(1)
    before = resident()
    action = np.zeros(1, np.int64)
    store = ReplayStore(transitions, NUM_ENVS, 1, SPACE, action, choices=4, **kwargs)
    never, ones = np.zeros((1, NUM_ENVS), bool), np.ones((1, NUM_ENVS), np.int64)

    def add(obs: Any, true: Any, action: Any, reward: Any, ended: Any) -> None:
        seen, acted = obs[None], action[None]
        rows = {"obs": seen, "action": acted, "reward": reward[None], "steps": ones}
        ends = {"terminated": ended[None], "truncated": never}
        store.add(Batch(**rows, **ends, next_obs=true[None]))

    speed = filled(transitions, add)
    grown = resident() - before
    gamma, rngs = torch.tensor([0.99]), [np.random.default_rng(0)]
    batch = PRIORITIZED_BATCH if kwargs.get("prioritized") else BATCH

    def draw() -> None:
        sample = store.sample(batch, gamma, rngs)
        store.update_priorities(sample.index, sample.reward)

    return {
        "bytes_mb": store.nbytes / MB,
        "resident_mb": grown,
        "adds_per_second": speed,
        "batch": batch,
        "sample_us": microseconds(draw),
    }


def stable_baselines3(transitions: int) -> dict[str, float]:
    import torch
    from stable_baselines3.common.buffers import ReplayBuffer

    torch.set_num_threads(1)
    before = resident()
    buffer = ReplayBuffer(transitions, SPACE, gym.spaces.Discrete(4), "cpu", NUM_ENVS)
    infos: list[dict[str, Any]] = [{} for _ in range(NUM_ENVS)]

    def add(obs: Any, true: Any, action: Any, reward: Any, ended: Any) -> None:
        buffer.add(obs, true, action, reward, ended, infos)

    speed = filled(transitions, add)
    arrays = [v for v in vars(buffer).values() if isinstance(v, np.ndarray)]
    return {
        "bytes_mb": sum(a.nbytes for a in arrays) / MB,
        "resident_mb": resident() - before,
        "adds_per_second": speed,
        "batch": BATCH,
        "sample_us": microseconds(lambda: buffer.sample(BATCH)),
    }


KINDS: dict[str, tuple[Callable[..., dict[str, float]], dict[str, Any]]] = {
    "uniform": (ours, {}),
    "3 steps": (ours, {"n_step": 3}),
    "prioritised, with update": (ours, {"prioritized": True}),
    "Stable-Baselines3": (stable_baselines3, {}),
}


def measured(kind: str, transitions: int) -> dict[str, float]:
    measure, kwargs = KINDS[kind]
    return measure(transitions, **kwargs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    given = parser.parse_args()
    rows = {}
    for kind in KINDS:
        with workers(1) as pool:
            rows[kind] = pool.submit(measured, kind, given.transitions).result()
    header = ["", *rows["uniform"]]
    print(table(header, [[k, *(f"{v:,.0f}" for v in row.values())] for k, row in rows.items()]))
    ratio = rows["uniform"]["sample_us"] / rows["Stable-Baselines3"]["sample_us"]
    report(
        "replay",
        {
            "transitions": given.transitions,
            "bytes_mb": rows["uniform"]["bytes_mb"],
            "resident_mb": rows["uniform"]["resident_mb"],
            "sample_time_over_sb3": ratio,
            "rows": rows,
        },
    )


if __name__ == "__main__":
    main()
