"""Shared parts of the benchmarks: the machine, processes, tables, recording and replaying."""

from __future__ import annotations

import argparse
import functools
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from skillweave.cli.jobs import Processes
from skillweave.envs.envpool_engine import EnvPoolEngine
from skillweave.errors import SkillweaveError
from skillweave.types import Array

workers = Processes
"""A pool of fresh processes that end when this one does, however it ends."""


def machine() -> str:
    cores = len(os.sched_getaffinity(0))
    return f"{platform.machine()}, {cores} cores, Python {platform.python_version()}"


def cases_asked(
    parser: argparse.ArgumentParser, cases: Iterable[str], steps: int
) -> argparse.Namespace:
    """Parse the command line of a benchmark whose cases are trained for ``steps``."""
    parser.add_argument("cases", nargs="*", default=["together", "flat"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--steps", type=int, default=steps)
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    if unknown := [case for case in asked.cases if case not in cases]:
        raise SkillweaveError(f"no case {unknown[0]!r}; there are: {', '.join(cases)}")
    return asked


def run_command(
    command: Sequence[str], *, capture: bool = False, check: bool = True, **how: Any
) -> subprocess.CompletedProcess[str]:
    """Run a command as ``subprocess.run`` does; a SIGTERM to this process also ends the command."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    pipe = subprocess.PIPE if capture else None
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, **how) as child:
        try:
            out, error = child.communicate()
        except BaseException:
            child.terminate()
            raise
    if check and child.returncode:
        raise subprocess.CalledProcessError(child.returncode, command, out, error)
    return subprocess.CompletedProcess(command, child.returncode, out, error)


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    cells = [[str(c) for c in row] for row in (header, *rows)]
    widths = [max(len(r[i]) for r in cells) for i in range(len(header))]
    lines = [" | ".join(c.rjust(w) for c, w in zip(r, widths, strict=True)) for r in cells]
    return "\n".join([lines[0], "-+-".join("-" * w for w in widths), *lines[1:]])


def report(name: str, result: dict[str, Any]) -> None:
    """Print a benchmark's result as JSON, and keep it under runs/benchmarks/."""
    result = {"benchmark": name, "machine": machine(), **result}
    print(json.dumps(result), flush=True)
    folder = Path("runs/benchmarks")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(result, indent=2))


median = statistics.median


class RecordedPool:
    """A bare pool that notes every call, so that another one can be fed with the same."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make, self.pool = make, make()
        self.calls: list[tuple[Array | None, Array]] = []  # the actions, if it is a step; the ids

    def reset(self, ids: Array) -> Any:
        self.calls.append((None, ids))
        return self.pool.reset(ids)

    def step(self, action: Array, ids: Array) -> Any:
        self.calls.append((action, ids))
        return self.pool.step(action, ids)

    def replay(self) -> tuple[int, float]:
        """Feed a bare pool with the calls; environment steps and seconds."""
        pool, steps = self.make(), 0
        started = time.perf_counter()
        for action, ids in self.calls:
            if action is None:
                pool.reset(ids)
            else:
                pool.step(action, ids)
                steps += len(ids)
        return steps, time.perf_counter() - started


@contextmanager
def recorded() -> Iterator[list[RecordedPool]]:
    """Yield the pools that are made in this block."""
    made: list[RecordedPool] = []
    real = EnvPoolEngine.make_pool

    def make_pool(engine: EnvPoolEngine, seed: int) -> RecordedPool:
        made.append(RecordedPool(functools.partial(real, engine, seed)))
        return made[-1]

    with mock.patch.object(EnvPoolEngine, "make_pool", make_pool):
        yield made


def warm_up() -> None:
    """Import what training imports, so that no timing pays for it."""
    import envpool  # noqa: F401
    import torch

    torch.ones(2, 2).matmul(torch.ones(2, 2))
    sys.stdout.flush()
