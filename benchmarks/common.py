"""What the benchmarks share: the machine, processes, tables, recording and replaying."""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skillweave.cli.processes import processes
from skillweave.envs.engine import Engine, RawStep
from skillweave.types import Array, SkillweaveError

workers = processes
"""A pool of fresh processes that end when this one does, however it ends."""


def machine() -> str:
    cores = len(os.sched_getaffinity(0))
    return f"{platform.machine()}, {cores} cores, Python {platform.python_version()}"


def cases_asked(
    parser: argparse.ArgumentParser, cases: Iterable[str], steps: int
) -> argparse.Namespace:
    """What the command line says of a benchmark whose cases are trained for so many steps."""
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
    """``subprocess.run``, but a SIGTERM to this process also ends the command's with SIGTERM."""
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


def median(values: Iterable[float]) -> float:
    return statistics.median(values)


class Recorder:
    """An engine that notes every call, so that the bare pool can be fed with the same ones."""

    def __init__(self, engine: Any) -> None:
        self.engine = engine
        self.num_envs = engine.num_envs
        self.observation_space, self.action_space = engine.observation_space, engine.action_space
        self.calls: list[tuple[str, Any, Any]] = []

    def reset(self, seed: int) -> Array:
        self.calls.append(("make", seed, None))
        return self.engine.reset(seed)

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        self.calls.append(("reset", None, ids.astype(np.int32)))
        return self.engine.reset_some(ids, seeds)

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        self.calls.append(
            ("step", action.astype(np.int32), None if ids is None else ids.astype(np.int32))
        )
        return self.engine.step(action, ids)

    def mask(self) -> Array | None:
        return self.engine.mask()

    def close(self) -> None:
        self.engine.close()

    def replay(self) -> tuple[int, float]:
        """Feed EnvPool alone with the recorded calls; environment steps and seconds."""
        pool: Any = None
        steps = 0
        started = time.perf_counter()
        for kind, what, ids in self.calls:
            if kind == "step":
                pool.step(what, ids)
                steps += len(what)
            elif kind == "reset":
                pool.reset(ids)
            else:
                pool = self.engine.make_pool(what)
                pool.reset()
        return steps, time.perf_counter() - started


def engine_maker(record: list[Recorder]) -> Any:
    """A stand-in for ``make_engine`` that records what it makes."""
    from skillweave.envs.make import make_engine

    def make(spec: Any, num_envs: int, threads: int | None = None) -> Engine:
        record.append(Recorder(make_engine(spec, num_envs, threads)))
        return record[-1]

    return make


def warm_up() -> None:
    """Import what training imports, so that no timing pays for it."""
    import envpool  # noqa: F401
    import torch

    torch.ones(2, 2).matmul(torch.ones(2, 2))
    sys.stdout.flush()
