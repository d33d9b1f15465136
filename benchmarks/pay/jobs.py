"""The jobs of ``python -m benchmarks.pay``: in a module of their own, as a process that is made
again can import nothing from a package's ``__main__``.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from benchmarks.common import workers
from benchmarks.pay import keys_and_doors, lander_missions, mazes, pick_and_place, shuttle
from benchmarks.pay.agents import Bench
from benchmarks.pay.results import Results
from benchmarks.pay.suite import Suite

SUITES: dict[str, Callable[[], Suite]] = {
    "shuttle": shuttle.suite,
    "pick-and-place": pick_and_place.suite,
    "lander-missions": lander_missions.suite,
    "mazes": mazes.suite,
    "keys-and-doors": keys_and_doors.suite,
}


def suite_of(name: str, quick: bool) -> Suite:
    """Return a suite by its name."""
    found = SUITES[name]()
    return found.quick() if quick else found


def one(name: str, quick: bool, out: Path, chain: str, seed: int, tasks: list[str] | None) -> None:
    """Do a chain of agents from one seed, in this process."""
    Bench(suite_of(name, quick), Results(out), seed).run(chain, tasks)


def run_all(jobs: list[tuple[str, bool, Path, str, int, list[str] | None]], processes: int) -> None:
    """Do all jobs side by side; F1's weights are chosen first, as all its seeds need them.

    Raises:
        Exception: of a job that failed; all others are ended then.
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
