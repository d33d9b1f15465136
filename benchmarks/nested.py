"""A hierarchy of two hierarchies (``examples/nested.py``): how it learns; killed and resumed, too.

    python -m benchmarks.nested [CASE …] [--seeds 0 1 2 3 4] [--steps 150000]

All cases have the same number of environment steps in all. Where a case is no flat agent, each run
is made a second time, killed (SIGKILL) in the middle of its last stage, and resumed; the weights of
both are then compared, bit for bit.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import cases_asked, median, report, table, workers
from benchmarks.grouped import regroup
from examples import nested
from skillweave import Hierarchy, SkillweaveError, TrainDefaults
from skillweave.runs.directory import RunDirectory

CASES = ("together", "apart", "apart, then together", "flat")


def declare(case: str, steps: int) -> Hierarchy:
    """Return the hierarchy with ``steps`` in all: seven stages apart, if there are any."""
    if case in ("together", "flat"):
        return nested.declare(steps, train_defaults=TrainDefaults(checkpoint_every=10_000))
    apart = steps if case == "apart" else steps // 2
    found = nested.declare(steps, learn=case)
    each = {"skill_steps": apart // 7, "selector_steps": apart // 7}
    regroup(found, **each, checkpoint_every=10_000, together_steps=steps - apart)
    for skill in found.skills:
        skill.policy.learn = "apart"
        regroup(skill.policy, **each)
    return found


def train(case: str, steps: int, seed: int, path: Path) -> None:
    """Train in a process that is to be killed."""
    declare(case, steps).train(path, seed=seed, quiet=True)


def killed(case: str, steps: int, seed: int, path: Path) -> RunDirectory:
    """Train a run, kill its process in the middle of its last stage, and resume it."""
    process = multiprocessing.get_context("spawn").Process(
        target=train, args=(case, steps, seed, path), daemon=True
    )
    process.start()
    while process.is_alive() and not _half_done(path):
        time.sleep(0.05)
    process.kill()
    process.join()
    if RunDirectory.open(path).finished:
        raise SkillweaveError(f"{path}: the run was over before it was killed")
    declare(case, steps).resume(path, quiet=True)
    return RunDirectory.open(path)


def _half_done(path: Path) -> bool:
    if not (path / "run.json").exists():
        return False
    run = RunDirectory.open(path)
    last = run.manifest.stages[-1]
    at = [x["steps"] for x in run.metrics() if x["stage"] == last.name]
    return bool(at) and at[-1] > last.budget / 2


def weights(run: RunDirectory) -> dict[str, dict[str, bytes]]:
    """Return all that every stage has learnt."""
    return {
        f"{stage.name}.{name}": {k: v.numpy().tobytes() for k, v in policy.to_file()[0].items()}
        for stage in run.manifest.stages
        for name, policy in run.load_policies(stage.name).items()
    }


def one(case: str, steps: int, seed: int) -> dict[str, Any]:
    """Train and score in this process; then once more, killed and resumed."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        flat = case == "flat"
        run = declare(case, steps).train(path / "whole", seed=seed, quiet=True, flat=flat)
        seconds = time.perf_counter() - started
        found = run.evaluate(100)
        spent = sum(s["steps"] for s in run.info()["stages"])
        same = None
        if not flat:
            again = killed(case, steps, seed, path / "killed")
            same = weights(again) == weights(RunDirectory.open(path / "whole"))
    solved = float(np.mean(np.array(found.returns) > 1))
    usage = found.to_json()["skill_usage"]
    return {
        "seed": seed,
        "solved": solved,
        "length": float(np.mean(found.lengths)),
        "steps": spent,
        "seconds": seconds,
        "usage": usage,
        "same": same,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    asked = cases_asked(parser, CASES, steps=150_000)
    rows, found = [], {}
    head = ("case", "median", "worst", "length", "steps", "s", "killed, resumed", "each")
    with workers(asked.processes) as pool:
        for case in asked.cases:
            pending = [pool.submit(one, case, asked.steps, seed) for seed in asked.seeds]
            found[case] = runs = [future.result() for future in pending]
            solved = [r["solved"] for r in runs]
            same = [r["same"] for r in runs]
            repeats = "–" if None in same else f"same {sum(same)}/{len(same)}"
            length = f"{median(r['length'] for r in runs):.1f}"
            steps = f"{median(r['steps'] for r in runs):,.0f}"
            seconds = f"{median(r['seconds'] for r in runs):.0f}"
            each = " ".join(f"{x:.0%}" for x in solved)
            score = f"{median(solved):.0%}", f"{min(solved):.0%}"
            rows.append((case, *score, length, steps, seconds, repeats, each))
            print(table(head, rows), flush=True)
    report("nested", {"seeds": asked.seeds, "steps": asked.steps, "cases": found})


if __name__ == "__main__":
    main()
