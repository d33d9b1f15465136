"""Repair of a handover: ``hover`` of ``lander-missions``, 100 steps in its box, after ``go_left``.

    python -m benchmarks.repair --seeds 0 1 2 3 4

For each seed of the repair it prints the handover matrices before and after, and whether the
result was kept. ``--run`` repairs the skills of another run, of other seeds for example.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

import skillweave as sw
from skillweave.calls import held
from skillweave.recipes.lander_missions import GoLeft, GoRight, Hover, by_leg, declare

HOVER_STEPS = 100
DONE = {
    "hover": held(Hover().in_box, HOVER_STEPS),
    "go_left": GoLeft().in_box,
    "go_right": GoRight().in_box,
}
"""The legs of a mission: a place, and a place that is held."""
LEAST = 20
"""The fewest calls of a pair that count for the worst change."""


def declared(run: Path) -> sw.Hierarchy:
    """Return the recipe's hierarchy, with the rule as selector if the run has not learnt one."""
    stages = json.loads((run / "run.json").read_text())["stages"]
    learnt = any("selector" in stage["learns"] for stage in stages)
    return declare() if learnt else declare(selector=by_leg)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--calls", type=int, default=400, help="of the pair, before and after")
    parser.add_argument("--run", help="the directory of a run of lander-missions; else the shipped")
    parser.add_argument("--to", help="a new folder for the repaired runs; else they are deleted")
    given = parser.parse_args()

    if given.run is None:
        run = sw.Hierarchy.pretrained("lander-missions")
    else:
        run = sw.load(given.run, declared(Path(given.run)))
    rates = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(given.to or temporary)
        for seed in given.seeds:
            began = time.perf_counter()
            new = run.repair(
                "hover",
                after="go_left",
                steps=given.steps,
                run_dir=folder / f"repair-{seed}",
                done=DONE,
                calls=given.calls,
                seed=seed,
                quiet=True,
            )
            (result,) = new.repairs[-1:]
            rates.append(result.later.of("hover", "go_left")[0])
            enough = (result.before.calls >= LEAST) & (result.later.calls >= LEAST)
            worst = np.where(enough, result.later.rate - result.before.rate, 0.0).min()
            print(f"== seed {seed} ({time.perf_counter() - began:.0f} s)\n{result}", flush=True)
            print(f"largest loss of another pair: {-100 * worst:.1f} points", flush=True)
    print(f"hover after go_left, later: {', '.join(f'{rate:.0%}' for rate in rates)}")


if __name__ == "__main__":
    main()
