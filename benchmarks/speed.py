"""Figures 6 to 8: training speed against Stable-Baselines3, and against EnvPool alone.

    python -m benchmarks.speed [--seeds 0 1 2 3 4]

"EnvPool alone" is the bare pool fed with the very calls that the training made: a trained
lander's physics costs more than a falling one's. Everything is measured in one run, in turn.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import cast

from benchmarks.common import median, recorded, report, table, warm_up
from benchmarks.grouped import act_by
from skillweave import Hierarchy, recipes
from skillweave.types import HierarchyPolicy


def stable_baselines3(steps: int, seed: int) -> float:
    """Return steps/s of SB3's PPO with rl-zoo3's settings, 16 environments in one process."""
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common.env_util import make_vec_env

    env = make_vec_env("LunarLander-v3", n_envs=16, seed=seed)
    model = sb3.PPO(
        "MlpPolicy",
        env,
        n_steps=1024,
        batch_size=64,
        gae_lambda=0.98,
        gamma=0.999,
        n_epochs=4,
        ent_coef=0.01,
        device="cpu",
        seed=seed,
    )
    threads = torch.get_num_threads()
    started = time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - started
    torch.set_num_threads(threads)
    return model.num_timesteps / seconds


def flat(seed: int, steps: int) -> tuple[float, float]:
    """Return steps/s of the flat agent, and of EnvPool alone fed with its calls."""
    hierarchy = recipes.load("lunar-lander")
    hierarchy.scale(steps / hierarchy.total_steps)
    return trained(hierarchy, seed, True)


def selector(seed: int) -> tuple[float, float]:
    """Return steps/s of the selector over shipped skills, and of EnvPool fed with its calls."""
    run = Hierarchy.pretrained("lunar-lander")
    hierarchy, policy_of_run = run.hierarchy, cast(HierarchyPolicy, run.policy)
    for skill, policy in zip(hierarchy.skills, policy_of_run.skills.policies, strict=True):
        act_by(skill, policy)
    return trained(hierarchy, seed, False)


def trained(hierarchy: Hierarchy, seed: int, flat: bool) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as folder, recorded() as pools:
        run = hierarchy.train(Path(folder) / "run", seed=seed, flat=flat, quiet=True)
        speed = run.info()["stages"][-1]["steps_per_second"]
    pools[0].replay()  # once to warm up
    counted = [pool.replay() for pool in pools]
    return speed, sum(steps for steps, _ in counted) / sum(seconds for _, seconds in counted)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--flat-steps", type=int, default=2_500_000)
    parser.add_argument("--sb3-steps", type=int, default=32_768)
    given = parser.parse_args()
    warm_up()
    rows = []
    for seed in given.seeds:
        theirs = stable_baselines3(given.sb3_steps, seed)
        flat_speed, flat_pool = flat(seed, given.flat_steps)
        selector_speed, selector_pool = selector(seed)
        rows.append(
            {
                "seed": seed,
                "sb3": theirs,
                "flat": flat_speed,
                "flat_over_sb3": flat_speed / theirs,
                "envpool_on_flat": flat_pool,
                "flat_over_envpool": flat_speed / flat_pool,
                "selector": selector_speed,
                "envpool_on_selector": selector_pool,
                "selector_over_envpool": selector_speed / selector_pool,
            }
        )
        print(
            table(
                list(rows[0]),
                [[f"{v:.3g}" if v < 100 else f"{v:,.0f}" for v in r.values()] for r in rows],
            )
        )
    ratios = [k for k in rows[0] if "over" in k]
    report("speed", {"median": {k: median(r[k] for r in rows) for k in ratios}, "rows": rows})


if __name__ == "__main__":
    main()
