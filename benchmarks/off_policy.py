"""Off-policy training speed against Stable-Baselines3: same network, batch and update ratio.

    python -m benchmarks.off_policy [--seeds 0 1 2] [--sizes small zoo]

`small` is the network that benchmarks.learning uses, `zoo` the one of rl-zoo3, whose matrix
products alone (see the column `floor`) take most of the time on two cores: no library can be much
faster with it. Eight environments in one process, with which Stable-Baselines3 is faster than with
one. Measured in turn, in one run, after a warm-up (and after ours compiled, which takes seconds).
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch

from benchmarks.bare import train_bare
from benchmarks.common import median, report, table
from skillweave import DQN, SAC, TD3, EnvSpec, Network
from skillweave._internal.seeding import Seeds
from skillweave.training.episodes import Tick

SIZES = {
    "dqn": {"small": (64, 64), "zoo": (256, 256)},
    "sac": {"small": (64, 64), "zoo": (400, 300)},
    "td3": {"small": (64, 64), "zoo": (400, 300)},
}
ENVS = {
    "dqn": "LunarLander-v3",
    "sac": "LunarLanderContinuous-v3",
    "td3": "LunarLanderContinuous-v3",
}
BATCH = {"dqn": 128, "sac": 256, "td3": 256}
WARM_UP = 500
ENVIRONMENTS = 8
THREADS = {"small": 1, "zoo": 2}  # for both: one is faster where the matrices are small


def ours(name: str, size: str, steps: int, seed: int, *, compile: bool) -> float:
    """Return steps/s after the warm-up: one gradient step for each environment step."""
    kind: Any = {"dqn": DQN, "sac": SAC, "td3": TD3}[name]
    extra = {"double": False} if name == "dqn" else {}
    config = kind(
        num_envs=ENVIRONMENTS,
        update_ratio=1.0,
        learning_starts=WARM_UP,
        batch_size=BATCH[name],
        buffer_size=50_000,
        network=Network(SIZES[name][size], "relu"),
        threads=THREADS[size],
        compile=compile,
        **extra,
    )
    # The same engine as theirs.
    ticks: list[Tick] = []
    spec = EnvSpec(ENVS[name], engine="sync")
    train_bare(spec, config, Seeds(seed), steps + 1000, lambda tick, stack: ticks.append(tick))
    first, last = ticks[0], ticks[-1]
    return (last.steps - first.steps) / (last.seconds - first.seconds)


def theirs(name: str, size: str, steps: int, seed: int) -> float:
    """Return the steps/s of Stable-Baselines3."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    class Clock(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 1000:  # what it did before is not counted, nor is ours
                self.started = time.perf_counter()
            return True

    common: dict[str, Any] = {
        "batch_size": BATCH[name],
        "buffer_size": 50_000,
        "learning_starts": WARM_UP,
        "policy_kwargs": {"net_arch": list(SIZES[name][size])},
        "device": "cpu",
        "seed": seed,
    }
    env = make_vec_env(ENVS[name], n_envs=ENVIRONMENTS, seed=seed)
    kind: Any = {"dqn": sb3.DQN, "sac": sb3.SAC, "td3": sb3.TD3}[name]
    model = kind("MlpPolicy", env, train_freq=1, gradient_steps=-1, **common)
    torch.set_num_threads(THREADS[size])
    clock = Clock()
    model.learn(steps + 1000, callback=clock)
    return steps / (time.perf_counter() - clock.started)


def floor(name: str, size: str) -> float:
    """Return updates/s if an update were only the matrix products of its hidden layers."""
    torch.set_num_threads(THREADS[size])
    n_in, n_out = SIZES[name][size]
    x, w = torch.randn(BATCH[name], n_in), torch.randn(n_in, n_out)
    times = []
    for _ in range(200):
        started = time.perf_counter()
        torch.mm(x, w)
        times.append(time.perf_counter() - started)
    # Forward, and twice that backward. DQN: online 3, target 1. SAC: the actor 1 + 3, two critics
    # 2 (targets) + 6 (loss) + 4 (for the actor, by their inputs alone); TD3: the actor and one
    # critic for it half as often.
    products = {"dqn": 4, "sac": 16, "td3": 1 + 2 + 6 + 0.5 * (3 + 2)}[name]
    return 1.0 / (products * float(np.median(times)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--sizes", nargs="+", default=["small", "zoo"])
    parser.add_argument("--steps", type=int, default=3_000)
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for name in ENVS:
        for size in given.sizes:
            hidden = SIZES[name][size]
            for seed in given.seeds:
                base = theirs(name, size, given.steps, seed)
                plain = ours(name, size, given.steps, seed, compile=False)
                mine = ours(name, size, given.steps, seed, compile=True)
                rows.append(
                    {
                        "algorithm": name,
                        "network": "x".join(map(str, hidden)),
                        "seed": seed,
                        "sb3": round(base),
                        "ours": round(plain),
                        "compiled": round(mine),
                        "ours/sb3": round(plain / base, 2),
                        "ratio": round(mine / base, 2),
                        "floor": round(floor(name, size)),
                    }
                )
    print(table(list(rows[0]), [list(r.values()) for r in rows]))
    ratios = {
        f"{name} {size}": median(
            r["ratio"]
            for r in rows
            if r["algorithm"] == name and r["network"] == "x".join(map(str, SIZES[name][size]))
        )
        for name in ENVS
        for size in given.sizes
    }
    report("off_policy", {"median_ratio": ratios, "rows": rows})


if __name__ == "__main__":
    main()
