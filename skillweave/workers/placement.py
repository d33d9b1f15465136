"""The placement of collectors and workers: in processes of this machine, or on Ray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from skillweave._internal.notices import notice
from skillweave.experience.group import CollectorGroup, Collectors, MakeCollector, share_of
from skillweave.workers.host import LocalWorker, WorkerCollectors, WorkerFactory, Workers
from skillweave.workers.processes import ProcessWorker
from skillweave.workers.start_methods import runs_again, why_no_processes

MakeCollectors = Callable[[MakeCollector, int, int, int, str], CollectorGroup]
"""Makes collectors, as ``make_collectors`` does."""


def make_collectors(
    make: MakeCollector, num_envs: int, workers: int, members: int, name: str
) -> CollectorGroup:
    """Make collectors of ``num_envs`` environments: one in this thread, or ``workers`` processes.

    Args:
        make: makes one.
        workers: 0 and 1: in this thread.

    Raises:
        DeclarationError: the environments cannot be shared out equally.
    """
    if workers <= 1:
        return Collectors([make(num_envs, 0)], members)
    each = share_of(num_envs, workers, members, name)
    if why := why_no_processes() or runs_again():
        notice(
            f"{name}: its {workers} collectors work in this process, one after another, as {why}"
        )
        return Collectors([make(each, i * each) for i in range(workers)], members)
    apart = [ProcessWorker(make, each, i) for i in range(workers)]
    return WorkerCollectors(apart, each, members, name)


MakeWorkers = Callable[[WorkerFactory, int, str], Workers]
"""Given what makes the thing that stands at a worker (of 1 and its number), how many workers, and
what messages call the environment."""


@dataclass(frozen=True)
class Placement:
    """Makes collectors, and workers that do other things than collecting."""

    collectors: MakeCollectors
    workers: MakeWorkers


def _processes(make: WorkerFactory, count: int, name: str) -> Workers:
    if why := why_no_processes() or runs_again():
        notice(f"{name}: its {count} parts work in this process, one after another, as {why}")
        return Workers([LocalWorker(make, 1, i) for i in range(count)], name)
    return Workers([ProcessWorker(make, 1, i) for i in range(count)], name)


LOCAL = Placement(make_collectors, _processes)
"""On this machine."""
