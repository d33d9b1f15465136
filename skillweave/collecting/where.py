"""Where workers run: in processes of this machine, or on Ray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from skillweave.collecting.group import MakeCollectors, make_collectors
from skillweave.collecting.start_methods import runs_again, why_no_processes
from skillweave.collecting.workers import LocalWorker, MakeStanding, Workers
from skillweave.notices import notice

MakeWorkers = Callable[[MakeStanding, int, str], Workers]
"""Given what makes the thing that stands at a worker (of 1 and its number), how many workers, and
what messages call the environment."""


@dataclass(frozen=True)
class Where:
    """Makes collectors, and workers that do other things than collecting."""

    collectors: MakeCollectors
    workers: MakeWorkers


def _processes(make: MakeStanding, count: int, name: str) -> Workers:
    if why := why_no_processes() or runs_again():
        notice(f"{name}: its {count} parts work in this process, one after another, as {why}")
        return Workers([LocalWorker(make, 1, i) for i in range(count)], name)
    from skillweave.collecting.processes import process_workers

    return process_workers(make, count, name)


HERE = Where(make_collectors, _processes)
"""On this machine."""
