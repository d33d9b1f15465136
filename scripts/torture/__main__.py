"""The command line: run the parts, print one table; exit code 1 if anything failed."""

from __future__ import annotations

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", CUDA_VISIBLE_DEVICES="")

import argparse
import importlib
import shlex
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from scripts.torture.processes import run_cases
from scripts.torture.report import Tally, table

PARTS = ("files", "kills", "disk", "code", "surroundings")
COUNTS = {"files": 100_000, "kills": 1_000, "disk": 1_000, "code": 10_000, "surroundings": 360}
SMALL = {"files": 150, "kills": 10, "disk": 8}
"""Cases in ``make test``, of these samples and kinds."""
FEW = {
    "files": ["hierarchy of data", "weights", "AgileRL"],
    "kills": ["skills and selector", "replay of continuous actions"],
    "disk": ["skills and selector"],
}


def main() -> int:
    """Run what was asked for."""
    options = parse()
    torch.set_num_threads(1)
    preload()
    if options.case is not None:
        samples: Any = importlib.import_module("scripts.torture.samples")
        samples.PLOTTED = 1  # samples differ from run to run, and so does who is plotted
    tallies = []
    for part in options.parts or (SMALL if options.small else PARTS):
        if (tally := run_part(part, options)) is not None:
            tallies.append(tally)
    print("\n" + table(tallies))
    for tally in tallies:
        print(tally.examples(), end="\n" if tally.causes else "")
    return 1 if any(t.bad for t in tallies) else 0


def parse() -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser("scripts.torture", description=__doc__)
    parser.add_argument(
        "parts", nargs="*", metavar="part", help=f"{', '.join(PARTS)}; default: all"
    )
    parser.add_argument("--count", type=int, help=f"cases (kills: kills); default: {COUNTS}")
    parser.add_argument("--small", action="store_true", help="what make test does, without code")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="one case again; its files stay")
    parser.add_argument("--only", nargs="+", help="names of samples (files) or kinds (kills, disk)")
    parser.add_argument("--jobs", type=int, default=2, help="processes side by side")
    parser.add_argument("--out", type=Path, default=Path("runs/torture"), help="failing cases")
    options = parser.parse_args()
    options.counts = SMALL if options.small else COUNTS
    if unknown := [part for part in options.parts if part not in PARTS]:
        parser.error(f"no part {unknown[0]!r}; there are: {', '.join(PARTS)}")
    return options


def preload() -> None:
    """Import all that a case may need, so that a forked process has it."""
    backends = [f"matplotlib.backends.backend_{kind}" for kind in ("agg", "svg")]
    others = ("envpool", "onnx", "onnxruntime", "rich.console", "skillweave.cli.execute")
    for name in ("matplotlib.font_manager", *backends, *others):
        try:
            importlib.import_module(name)
        except ImportError:
            print(f"without {name}, which is not installed")


def run_part(name: str, options: argparse.Namespace) -> Tally | None:
    """Run one part; return its tally, or None where it is not there."""
    count = options.count or options.counts[name]
    if name == "code":
        from scripts.torture.code import tally

        return tally(count, options.seed)
    started = time.monotonic()
    memory = Path("/dev/shm")  # where the disk's own speed does not count
    folder = Path(
        tempfile.mkdtemp(prefix=f"torture-{name}-", dir=memory if memory.exists() else None)
    )
    try:
        only = options.only or (FEW[name] if options.small else None)
        part = make_part(name, folder, options.seed, only)
        words = ["--seed", str(options.seed), *(["--only", *only] if only else [])]
        found = Tally(name, shlex.join(words))
        if options.case is None:
            run_all(part, range(part.cases(count)), found, options)
        else:
            run_all(part, range(options.case, options.case + 1), found, options)
            print(f"its files: {folder}")
    finally:
        if options.case is None:
            shutil.rmtree(folder)
    print(f"{name}: {found.counts.total():,} cases in {time.monotonic() - started:.0f} s")
    return found


def run_all(part: Any, numbers: range, found: Tally, options: argparse.Namespace) -> None:
    """Run cases and count them; say every ten seconds how far that is, or all of a single case."""
    shown = time.monotonic()
    how: dict[str, Any] = {"jobs": options.jobs, "limit": part.limit, "prepare": part.prepare}
    for number, outcome in run_cases(part.case, numbers, **how):
        found.add(number, outcome, options.out / f"{found.part}.jsonl")
        if len(numbers) == 1:
            print(f"case {number}, {outcome.what}: {outcome.category}\n{outcome.said}")
        elif time.monotonic() > shown + 10.0:
            shown, done = time.monotonic(), found.counts.total()
            print(f"{found.part}: {done:,} of {len(numbers):,}, {found.bad:,} failures", flush=True)


def make_part(name: str, folder: Path, seed: int, only: list[str] | None) -> Any:
    """Return the part of this name; ``only``: the samples or kinds that it takes."""
    module = importlib.import_module(f"scripts.torture.{name}")
    return getattr(module, name.capitalize())(folder, seed, *([only] if only else []))


if __name__ == "__main__":
    sys.exit(main())
