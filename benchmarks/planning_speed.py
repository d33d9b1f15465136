"""The seconds of planning: a log, a plan of it, a new mission, and one decision.

    python -m benchmarks.planning_speed [--steps 100000]

The skills are those of ``lander-missions``, with their shipped weights. A fit is ``Run.plan``: the
graph of logged calls and a first mission; a new mission is planned on the same log again, and a
decision is one call of the planner for one observation. Seconds are of processor time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.common import median, report, table
from skillweave import Hierarchy
from skillweave.calls import Predicate, held
from skillweave.planning import Mission
from skillweave.recipes._missions import HALF, POINTS

DECISIONS = 200


def inside(number: int, name: str) -> Predicate:
    """Return the predicate that the lander is in one of the boxes."""
    point, half = POINTS[number], HALF[number]
    return Predicate(lambda obs: (np.abs(obs[:, :2] - point) <= half).all(axis=1), name, "obs")


def seconds(function: Callable[[], Any], rounds: int = 3) -> tuple[float, Any]:
    """Return the median time of a function, and its result."""
    times = []
    for _ in range(rounds):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return median(times), result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000)
    steps = parser.parse_args().steps
    left, right, hover = (inside(i, name) for i, name in enumerate(("left", "right", "hover")))
    run = Hierarchy.pretrained("lander-missions")
    logging, log = seconds(lambda: run.log_calls(steps), rounds=1)
    fit, planned = seconds(lambda: run.plan(Mission(left, right, held(hover, 100)), log))
    new, _ = seconds(lambda: planned.plan(Mission(right, left, held(hover, 100)), log))
    planner = planned.hierarchy.selector.among(log.skills)
    rows = np.random.default_rng(0).integers(len(log), size=DECISIONS)
    memory = planner.start(1)
    decisions = []
    for row in rows:
        start = time.process_time()
        _, memory = planner.act(memory, log.start[row][None])
        decisions.append(time.process_time() - start)
    rows_of_table = [
        ("log", f"{logging:.1f}"),
        ("fit", f"{fit:.2f}"),
        ("new mission", f"{new:.2f}"),
        ("decision", f"{median(decisions):.5f}"),
    ]
    print(table(("seconds", f"{log.steps:,} logged steps"), rows_of_table))
    report(
        "planning_speed",
        {"steps": log.steps, "fit": fit, "new": new, "decision": median(decisions)},
    )


if __name__ == "__main__":
    main()
