"""Tasks where skills pay, held against flat agents, at equal steps, on five seeds.

    python -m benchmarks.pay [SUITE[/TASK] …] [--seeds 0 1 2 3 4] [--processes 2] [--quick]
        [--agents hierarchy flat shaped bonus] [--out runs/pay] [--only-figures]

Suites: shuttle, pick-and-place, lander-missions, mazes, keys-and-doors. A result that is in the
folder is not made again, and a training that was killed goes on where it stood, so the same command
finishes what it began. Results of other code than today's are named under the table.

Agents: F0 flat; F1 flat, on the task's reward and the weighted sum of the skills' rewards (weights
chosen on seed 100); F2 flat with a bonus for states that were seldom seen; F3 flat, fine-tuned from
earlier tasks; F4 random skills, and the best single skill. Each has as many steps on a task as the
hierarchy has there. On the first task these are also the steps that learn the skills; F0 to F2 have
those on the lander's tour, too. F1 and F2 learn the first task of each suite, the lander's tour,
and any task that is named.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.pay.agents import CHAINS
from benchmarks.pay.figures import draw, make_table, reported
from benchmarks.pay.jobs import SUITES, run_all, suite_of
from benchmarks.pay.results import Results, hours, of_other_code
from skillweave.errors import SkillweaveError


def chosen(asked: list[str]) -> dict[str, list[str] | None]:
    """Return the requested tasks by suite; None: all of them.

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


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", metavar="SUITE[/TASK]")
    parser.add_argument("--seeds", type=int, nargs="+")
    parser.add_argument("--agents", nargs="+", choices=CHAINS, default=list(CHAINS))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--quick", action="store_true", help="one seed, a 200th of the steps: 6 minutes"
    )
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
    spent = 0.0
    for name in suites:
        suite = suite_of(name, asked.quick)
        results = reported(every := Results(out).all(name), seeds)
        spent += hours(every)
        if results:
            print(f"\n{name}\n{make_table(suite, results)}")
            if warning := of_other_code(results):
                print(warning)
            print(*draw(suite, results, out), sep="\n", flush=True)
    print(f"\nall results of these suites took {spent:.1f} hours, one after another")


if __name__ == "__main__":
    try:
        main()
    except SkillweaveError as error:
        sys.exit(f"error: {error}")
