"""Where workers run: in processes of this machine, or on Ray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from skillweave.collecting.group import MakeCollectors, make_collectors
from skillweave.collecting.workers import MakeStanding, Workers

MakeWorkers = Callable[[MakeStanding, int, str], Workers]
"""Given what makes the thing that stands at a worker (of 1 and its number), how many workers, and
what messages call the environment."""


@dataclass(frozen=True)
class Where:
    """Makes collectors, and workers that do other things than collecting."""

    collectors: MakeCollectors
    workers: MakeWorkers


def _processes(make: MakeStanding, count: int, name: str) -> Workers:
    from skillweave.collecting.processes import process_workers

    return process_workers(make, count, name)


HERE = Where(make_collectors, _processes)
"""On this machine."""
