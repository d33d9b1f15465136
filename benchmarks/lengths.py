"""Fixed lengths of calls against chosen ones with interruption, over the same learnt skills.

    python -m benchmarks.lengths [--seeds 0 1 2] [--steps 300000] [--out runs/lengths]
        [--only 5 10 25 50 chosen]

The recipe ``mazes``: skills are learnt once for each seed, in the large maze; then a selector
learns over them from equally many steps: with calls of 5, 10, 25 and 50 steps at most, and with
lengths that it chooses and calls that it cuts. A score is the share of 100 episodes that reach the
goal, where the selector samples. A result that is in the folder is not made again.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.grouped import regroup
from skillweave import Lengths
from skillweave.recipes import mazes
from skillweave.types import Array

FIXED = (5, 10, 25, 50)
CHOSEN = "chosen"
LENGTHS = Lengths(*FIXED)
EPISODES = 100


def settings(calls: str) -> dict[str, Any]:
    """Return the hierarchy's settings, for calls of a number of steps or of chosen lengths."""
    if calls == CHOSEN:
        return {"call_steps": LENGTHS, "interrupt": True}
    return {"call_steps": int(calls)}


def skills_of(seed: int, out: Path) -> dict[str, Any]:
    """Return the skills that are learnt from a seed, or were before."""

    def no_selector(obs: Array) -> Array:
        return np.zeros(len(obs), np.int64)

    hierarchy, path = mazes.declare(selector=no_selector), out / f"skills-{seed}"
    run = hierarchy.load(path) if path.exists() else hierarchy.train(path, seed=seed, quiet=True)
    policy: Any = run.policy
    return dict(zip(policy.labels, policy.skills.policies, strict=True))


def score(calls: str, seed: int, steps: int, out: Path) -> float:
    """Return the share of episodes that reach the goal."""
    file = out / f"{calls}-{steps}-{seed}.json"
    if file.exists():
        return float(json.loads(file.read_text())["score"])
    hierarchy = mazes.with_skills("large", skills_of(seed, out))
    regroup(hierarchy, **settings(calls), selector_steps=steps)
    path = file.with_suffix("")
    if path.exists():
        run = hierarchy.resume(path, quiet=True)
    else:
        run = hierarchy.train(path, seed=seed, quiet=True)
    found = run.evaluate(EPISODES, deterministic=False)
    spent = sum(int(s["steps"]) for s in run.info()["stages"])
    content = {"score": found.mean, "steps": spent, "usage": found.to_json()["skill_usage"]}
    file.write_text(json.dumps(content))
    return float(found.mean)


def table(scores: dict[str, Sequence[float]]) -> str:
    """Calls, the median, and the score of each seed."""
    rows = [f"{'calls':>8}  median  seeds"]
    for calls, found in scores.items():
        each = " ".join(f"{s:.2f}" for s in found)
        rows.append(f"{calls:>8}  {statistics.median(found):6.2f}  {each}")
    return "\n".join(rows)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    every = [*map(str, FIXED), CHOSEN]
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--out", type=Path, default=Path("runs/lengths"))
    parser.add_argument("--only", nargs="+", choices=every, default=every, metavar="CALLS")
    asked = parser.parse_args(arguments)
    asked.out.mkdir(parents=True, exist_ok=True)
    scores: dict[str, list[float]] = {calls: [] for calls in asked.only}
    for seed in asked.seeds:
        for calls in asked.only:
            scores[calls].append(score(calls, seed, asked.steps, asked.out))
            print(f"seed {seed}, calls {calls}: {scores[calls][-1]:.2f}", flush=True)
    print(table(dict(scores.items())))


if __name__ == "__main__":
    main()
