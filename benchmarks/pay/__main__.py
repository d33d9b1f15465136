"""Tasks where skills pay, held against flat agents, at equal steps, on five seeds.

    python -m benchmarks.pay [SUITE[/TASK] …] [--seeds 0 1 2 3 4] [--processes 2] [--quick]
        [--agents hierarchy flat shaped bonus] [--out runs/pay] [--only-figures]

Suites: shuttle, pick-and-place, lander-missions, mazes. A result that is in the folder is not made
again, and a training that was killed goes on where it stood, so the same command finishes what it
began.

Agents, each with at least the hierarchy's steps, what learnt its skills included: F0 flat; F1 flat,
on the task's reward and the weighted sum of the skills' rewards (weights chosen on seed 100); F2
flat with a bonus for states that were seldom seen; F3 flat, fine-tuned from the first task; F4
random skills, and the best single skill.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from benchmarks.common import workers
from benchmarks.pay import lander_missions, mazes, pick_and_place, shuttle
from benchmarks.pay.agents import CHAINS, Bench
from benchmarks.pay.figures import draw, make_table, reported
from benchmarks.pay.results import Results
from benchmarks.pay.suite import Suite
from skillweave.types import SkillweaveError

SUITES: dict[str, Callable[[], Suite]] = {
    "shuttle": shuttle.suite,
    "pick-and-place": pick_and_place.suite,
    "lander-missions": lander_missions.suite,
    "mazes": mazes.suite,
}


def suite_of(name: str, quick: bool) -> Suite:
    """A suite by its name."""
    found = SUITES[name]()
    return found.quick() if quick else found


def chosen(asked: list[str]) -> dict[str, list[str] | None]:
    """By suite, the tasks that were asked for; None: all of them.

    Raises:
        SkillweaveError: there is no such suite or task.
    """
    found: dict[str, list[str] | None] = {}
    for word in asked or SUITES:
        suite, _, task = word.partition("/")
        if suite not in SUITES:
            raise SkillweaveError(f"no suite {suite!r}; there are: {', '.join(SUITES)}")
        if not task:
            found[suite] = None
            continue
        names = [t.name for t in SUITES[suite]().tasks]
        if task not in names:
            raise SkillweaveError(f"no task {task!r} in {suite}; there are: {', '.join(names)}")
        tasks = found.setdefault(suite, [])
        if tasks is not None:
            tasks.append(task)
    return found


def one(name: str, quick: bool, out: Path, chain: str, seed: int, tasks: list[str] | None) -> None:
    """A chain of agents from one seed, in this process."""
    Bench(suite_of(name, quick), Results(out), seed).run(chain, tasks)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", metavar="SUITE[/TASK]")
    parser.add_argument("--seeds", type=int, nargs="+")
    parser.add_argument("--agents", nargs="+", choices=CHAINS, default=list(CHAINS))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="small budgets, one seed, 10 minutes")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only-figures", action="store_true")
    asked = parser.parse_args(arguments)
    out = asked.out or Path("runs/pay-quick" if asked.quick else "runs/pay")
    seeds = asked.seeds or ([0] if asked.quick else [0, 1, 2, 3, 4])
    suites = chosen(asked.tasks)
    for name in suites:  # what is missing is said before anything is trained
        for task in suite_of(name, asked.quick).tasks:
            task.env.make().close()
    if not asked.only_figures:
        jobs = [
            (name, asked.quick, out, chain, seed, tasks)
            for seed in seeds
            for name, tasks in suites.items()
            for chain in asked.agents
        ]
        run_all(jobs, asked.processes)
    for name in suites:
        suite = suite_of(name, asked.quick)
        results = reported(Results(out).all(name), seeds)
        if results:
            print(f"\n{name}\n{make_table(suite, results)}")
            print(*draw(suite, results, out), sep="\n", flush=True)


def run_all(jobs: list[tuple[str, bool, Path, str, int, list[str] | None]], processes: int) -> None:
    """Do all jobs, so many side by side; F1's weights are chosen first, as all its seeds need them.

    Raises:
        Exception: of the first job that failed, when all others are done.
    """
    if processes == 1:
        for job in jobs:
            one(*job)
        return
    with workers(processes) as pool:
        first = {(j[0], j[1], j[2]) for j in jobs if j[3] == "shaped"}
        tuning = [pool.submit(tune, *key) for key in sorted(first, key=str)]
        others = [pool.submit(one, *j) for j in jobs if j[3] != "shaped"]
        for future in tuning:
            future.result()
        futures: list[Future[None]] = [pool.submit(one, *j) for j in jobs if j[3] == "shaped"]
        for future in (*others, *futures):
            future.result()


def tune(name: str, quick: bool, out: Path) -> None:
    """Choose F1's weights for a suite."""
    Bench(suite_of(name, quick), Results(out), 0).tuned_weights()


if __name__ == "__main__":
    try:
        main()
    except SkillweaveError as error:
        sys.exit(f"error: {error}")
