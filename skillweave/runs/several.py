"""Runs at paths of the user: a run's directory, or a directory of runs such as a sweep."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from skillweave.errors import DeclarationError
from skillweave.runs.directory import RunDirectory


def open_runs(paths: Sequence[Path]) -> list[RunDirectory]:
    """Open the runs at ``paths``; a directory of runs stands for all of them, in their order.

    Raises:
        RunError: a path holds no run, or a run is damaged.
    """
    runs = []
    for path in paths:
        inside = [] if (path / "run.json").exists() else _runs_in(path)
        # Without a run, opening the path raises an error that explains runs.
        runs += [RunDirectory.open(each) for each in inside or [path]]
    if not runs:
        raise DeclarationError("no runs were given; name a run's directory, or a sweep's")
    return runs


def _runs_in(path: Path) -> list[Path]:
    """Return the runs directly below a directory: s2 before s10."""
    if not path.is_dir():
        return []
    runs = [each.parent for each in path.glob("*/run.json")]
    return sorted(runs, key=lambda run: _by_numbers(run.name))


def _by_numbers(name: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts numbers in names by their size."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]
