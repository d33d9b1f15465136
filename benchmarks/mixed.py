"""The lunar-lander hierarchy with other algorithms at either level, at equal steps.

    python -m benchmarks.mixed [--seeds 0 1 2 3 4] [--processes 2]

All PPO, a DQN selector over the same PPO skills, and a PPO selector over DQN skills.
"""

from __future__ import annotations

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.common import median, report, table
from skillweave import DQN, Network, recipes

SELECTOR = DQN(
    num_envs=64,
    update_ratio=0.5,
    batch_size=256,
    learning_starts=2_000,
    learning_rate=1e-3,
    learning_rate_schedule="linear",
    gamma=0.999,
    tau=0.01,
    exploration_fraction=0.3,
    network=Network((64, 64), "relu"),
)
SKILL = DQN(
    num_envs=64,
    update_ratio=1 / 16,
    batch_size=256,
    learning_starts=10_000,
    learning_rate=1e-3,
    learning_rate_schedule="linear",
    gamma=0.98,
    n_step=3,
    tau=0.01,
    exploration_fraction=0.3,
    exploration_final_eps=0.02,
    network=Network((128, 128), "relu", layer_norm=True),
)


def learn(seed: int) -> dict[str, Any]:
    """Scores of the three for one seed."""
    scores: dict[str, Any] = {"seed": seed}
    with tempfile.TemporaryDirectory() as folder:
        plain = recipes.load("lunar-lander")
        steps = plain.total_steps
        run = plain.train(Path(folder) / "ppo", seed=seed, quiet=True)
        scores["all PPO"] = run.evaluate().mean
        # The same skills, as they were trained: only the selector is another.
        other = recipes.load("lunar-lander")
        other.selector = SELECTOR
        policies: Any = run.policy
        for skill, policy in zip(other.skills, policies.skills.policies, strict=True):
            skill.policy = policy
        scores["DQN selector"] = (
            other.train(Path(folder) / "selector", seed=seed, quiet=True).evaluate().mean
        )
        third = recipes.load("lunar-lander")
        for skill in third.skills:
            skill.algorithm = SKILL
        assert third.total_steps == steps
        scores["DQN skills"] = (
            third.train(Path(folder) / "skills", seed=seed, quiet=True).evaluate().mean
        )
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    with ProcessPoolExecutor(given.processes, get_context("spawn")) as pool:
        rows = list(pool.map(learn, given.seeds))
    print(table(list(rows[0]), [[round(v, 1) for v in r.values()] for r in rows]))
    middle = {k: median(r[k] for r in rows) for k in rows[0] if k != "seed"}
    ratios = {k: v / middle["all PPO"] for k, v in middle.items()}
    worst = {k: min(r[k] for r in rows) for k in middle}
    report("mixed", {"median": middle, "worst": worst, "ratio_of_medians": ratios, "rows": rows})


if __name__ == "__main__":
    main()
