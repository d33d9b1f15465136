"""Training time of a selector for a new mission, over ready skills.

    python -m benchmarks.weaving RUN [RUN …] [--mission tour] [--seed 0] [--steps N]

A RUN is one of ``skillweave train lander-missions``: its skills are used, its selector is not. One
selector after the other is trained, and plays 50 episodes of Gymnasium's lander. Seconds are those
of ``train()``; the episodes come after it. Seconds depend on the machine. So a flat PPO agent, the
recipes', trains on plain LunarLander-v3 before each selector, and the ratio is of steps a second.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bare import train_bare
from benchmarks.common import median, report, table, warm_up
from benchmarks.grouped import regroup
from skillweave import recipes
from skillweave._internal.seeding import Seeds
from skillweave.recipes import lander_missions as missions

EPISODES, FLAT_STEPS = 50, 200_000


def flat_seconds() -> float:
    """Return the training time of the baseline."""
    lander = recipes.load("lunar-lander")
    config = lander.train_defaults.flat or lander.algorithm
    started = time.perf_counter()
    train_bare(lander.spec, config, Seeds(0) / "flat", FLAT_STEPS, lambda *_: None)
    return time.perf_counter() - started


def trained_selector(source: Path, mission: str, seed: int, steps: int | None) -> dict[str, Any]:
    """Train a selector over a run's skills, and score it."""
    policy: Any = missions.declare().load(source).policy
    skills = dict(zip(policy.labels, policy.skills.policies, strict=True))
    hierarchy = missions.with_skills(mission, skills)
    if steps is not None:
        regroup(hierarchy, selector_steps=steps)
    flat = flat_seconds()
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        run = hierarchy.train(Path(folder) / "run", seed=seed, quiet=True)
        seconds = time.perf_counter() - started
        made = run.info()["stages"][-1]["steps"]
        returns = run.evaluate(EPISODES).returns
    return {
        "run": str(source),
        "steps": made,
        "seconds": seconds,
        "ratio": made / seconds / (FLAT_STEPS / flat),
        "complete": float(np.mean(np.array(returns) > 0.999)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--mission", choices=missions.MISSIONS, default="tour")
    parser.add_argument("--seed", type=int, default=0, help="of the selectors")
    parser.add_argument("--steps", type=int, help="of each; default: the recipe's")
    asked = parser.parse_args()
    warm_up()
    found = []
    for source in asked.runs:
        found.append(trained_selector(source, asked.mission, asked.seed, asked.steps))
        rows = [
            (
                r["run"],
                f"{r['steps']:,}",
                f"{r['seconds']:.1f}",
                f"{r['ratio']:.2f}",
                f"{r['complete']:.0%}",
            )
            for r in found
        ]
        header = ("skills of", "steps", "s", "÷ flat PPO's steps a second", "complete")
        print(table(header, rows), flush=True)
    ratios = [r["ratio"] for r in found]
    seconds = median(r["seconds"] for r in found)
    print(f"median {seconds:.1f} s, {median(ratios):.2f} of flat PPO's steps a second")
    report("weaving", {"mission": asked.mission, "seed": asked.seed, "runs": found})


if __name__ == "__main__":
    main()
