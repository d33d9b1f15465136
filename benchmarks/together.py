"""What learning together is worth: key and door (MiniGrid), against flat agents.

    python -m benchmarks.together [CASE …] [--seeds 0 1 2 3 4] [--size 8x8] [--steps 500000]

Every case has the same number of environment steps in all. Scores are 100 sampled episodes of
MiniGrid's own environment, with seeds that training never saw. Training steps EnvPool's, or with
``--engine sync`` MiniGrid's own. Two runs go side by side (``--processes``), so the seconds are
those of a busy machine.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import cases_asked, median, report, table, workers
from examples import doorkey
from skillweave import Hierarchy, Lengths, Together

FLOOR = Together(floor=1.0, floor_final=0.1)

FLOORS = {"floor": FLOOR.floor, "floor_final": FLOOR.floor_final}
declare = functools.partial(doorkey.declare, workers=1)  # runs go side by side


def apart(size: str, steps: int, **how: Any) -> Hierarchy:
    """Three skills apart, each after calls of those before, then the selector."""
    asked = {"start_calls": 8, "selector": doorkey.algorithm(**FLOORS)} | how
    return declare(
        size, learn="apart", skill_steps=steps // 5, selector_steps=2 * steps // 5, **asked
    )


CASES: dict[str, Callable[..., Hierarchy]] = {
    "together": declare,
    "apart": apart,
    "no start calls": functools.partial(apart, start_calls=None),
    "low floor": functools.partial(declare, together=Together(floor=0.3, floor_final=0.02)),
    "no floor": functools.partial(declare, together=Together(floor=0.0, floor_final=0.0)),
    "no call cost": functools.partial(declare, call_cost=0.0),
    "task advantage": functools.partial(declare, together=replace(FLOOR, task_weight=1.0)),
    "lengths": functools.partial(declare, call_steps=Lengths(4, ..., 64)),
    "interrupt": functools.partial(declare, interrupt=True),
    "flat": declare,
}
"""By name, a hierarchy of this size of the task, with so many steps."""


def one(case: str, size: str, steps: int, engine: str, seed: int) -> dict[str, Any]:
    """Train and score in this process."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        hierarchy = CASES[case](size, steps, engine=engine)
        run = hierarchy.train(Path(folder) / "run", seed=seed, quiet=True, flat=case == "flat")
        seconds = time.perf_counter() - started
        found = run.evaluate(100, deterministic=False)
        spent = sum(s["steps"] + s["evaluation_steps"] for s in run.info()["stages"])
    usage = found.to_json()["skill_usage"]
    solved = float(np.mean(np.array(found.returns) > 0))
    return {"seed": seed, "solved": solved, "steps": spent, "seconds": seconds, "usage": usage}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", default="8x8")
    parser.add_argument("--engine", choices=("auto", "sync"), default="auto")
    asked = cases_asked(parser, CASES, steps=500_000)
    rows, found = [], {}
    with workers(asked.processes) as pool:
        futures = {
            case: [
                pool.submit(one, case, asked.size, asked.steps, asked.engine, s)
                for s in asked.seeds
            ]
            for case in asked.cases
        }
        for case, pending in futures.items():
            found[case] = runs = []
            for future in pending:
                runs.append(future.result())
                told = runs[-1]
                print(f"{case}, seed {told['seed']}: {told['solved']:.0%} solved", flush=True)
            solved = [r["solved"] for r in runs]
            seconds = f"{median(r['seconds'] for r in runs):.0f}"
            steps = f"{median(r['steps'] for r in runs):,.0f}"
            each = " ".join(f"{x:.0%}" for x in solved)
            rows.append((case, f"{median(solved):.0%}", f"{min(solved):.0%}", steps, seconds, each))
            print(table(("case", "median", "worst", "steps", "s", "each"), rows), flush=True)
    report("together", {"size": asked.size, "seeds": asked.seeds, "cases": found})


if __name__ == "__main__":
    main()
