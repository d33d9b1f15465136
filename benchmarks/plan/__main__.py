"""New tasks planned on logged calls, beside selectors that are trained for them.

    python -m benchmarks.plan [FAMILY[/TASK] …] [--seeds 0 1 2 3 4] [--logs 1 2 3]
        [--agents planner by-hand selector trained] [--out runs/plan] [--only-table]
    python -m benchmarks.plan.chains

Families: lander (six orders of legs, 40,000 logged steps), mazes (20,000 to 50,000), shuttle and
bridge (100,000). The skills of each seed are trained once, and never see the tasks; for each there
are three logs. Seed 0 has the shipped skills where there are some. What is in the folder is not
made again, so the same command finishes what it began.

Agents: ``planner``, on each log; ``by-hand``, a rule that knows the task; ``selector``, trained for
as many steps as were logged; ``trained``, for as many as its recipe takes. All have the same
skills. The environment itself is the judge: a score is the share of 64 episodes that do the whole
task, on shuttle its return.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common import table
from benchmarks.pay.results import Result, of_other_code
from benchmarks.plan.cells import AGENTS, BY_HAND, LOG_SEEDS, PLANNER, Cells, results_in, shares
from benchmarks.plan.families import FAMILIES, Family, NewTask
from skillweave.errors import SkillweaveError
from skillweave.ops.threads import torch_threads


def chosen(words: Sequence[str]) -> list[tuple[Family, list[NewTask]]]:
    """Return families with the requested tasks.

    Raises:
        SkillweaveError: there is no such family or task.
    """
    asked: dict[str, list[str]] = {}
    for word in words or FAMILIES:
        name, _, task = word.partition("/")
        if name not in FAMILIES:
            raise SkillweaveError(f"no family {name!r}; there are: {', '.join(FAMILIES)}")
        asked.setdefault(name, []).extend([task] if task else [])
    found = []
    for name, tasks in asked.items():
        family = FAMILIES[name]()
        names = [t.name for t in family.tasks]
        if unknown := [t for t in tasks if t not in names]:
            raise SkillweaveError(f"no task {unknown[0]!r} in {name}; there are: {names}")
        found.append((family, [family.task(t) for t in tasks or names]))
    return found


def make_table(family: Family, tasks: Sequence[NewTask], results: Sequence[Result]) -> str:
    """Return a line for each task and agent, and one for the planner on all tasks."""
    rows = []
    for task in tasks:
        for agent in AGENTS:
            of = [r for r in results if r.task == task.name and _agent(r) == agent]
            if of:
                rows.append((task.name, agent, f"{of[0].budget:,}", *_numbers(of, family.good)))
    planned = [r for r in results if _agent(r) == PLANNER and r.task in {t.name for t in tasks}]
    if len(tasks) > 1 and planned:
        rows.append(("all", PLANNER, "", *_numbers(planned, family.good)))
    good = f">= {family.good:.2f}"
    return table(("task", "agent", "steps", "cells", "median", "worst", good), rows)


def _agent(result: Result) -> str:
    return PLANNER if result.agent.startswith(PLANNER) else result.agent


def _numbers(results: list[Result], good: float) -> tuple[str, ...]:
    median, worst, many = shares(results, good)
    return str(len(results)), f"{median:.2f}", f"{worst:.2f}", str(many)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", metavar="FAMILY[/TASK]")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument(
        "--logs", type=int, nargs="+", default=[1, 2, 3], choices=range(1, 1 + len(LOG_SEEDS))
    )
    parser.add_argument("--agents", nargs="+", choices=AGENTS, default=list(AGENTS))
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--out", type=Path, default=Path("runs/plan"))
    parser.add_argument("--only-table", action="store_true")
    asked = parser.parse_args(arguments)
    for family, tasks in chosen(asked.tasks):
        if not asked.only_table:
            for seed in asked.seeds:
                measure(family, tasks, seed, asked)
        results = [r for r in results_in(asked.out).all(family.name) if r.seed in asked.seeds]
        if results:
            print(f"\n{family.name}\n{make_table(family, tasks, results)}", flush=True)
            if warning := of_other_code(results):
                print(warning)


def measure(family: Family, tasks: Sequence[NewTask], seed: int, asked: argparse.Namespace) -> None:
    """Measure the requested agents on tasks with one seed's skills."""
    cells = Cells(family, asked.out, seed, asked.episodes, lambda text: print(text, flush=True))
    for task in tasks:
        for agent in asked.agents:
            if agent == BY_HAND and family.by_hand is None:
                continue
            for number in asked.logs if agent == PLANNER else [0]:
                cells.run(task, agent, number)


if __name__ == "__main__":
    try:
        with torch_threads(1):
            main()
    except SkillweaveError as error:
        sys.exit(f"error: {error}")
