"""Hostile user code and environments: the cases themselves are tests/hostile.py's."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from scripts.torture.report import Tally

TESTS = Path(__file__).parents[2] / "tests"


def tally(count: int, seed: int) -> Tally | None:
    """The counts of so many examples, failures in capitals; None: there is no tests/hostile.py."""
    sys.path.insert(0, str(TESTS))
    try:
        hostile = importlib.import_module("hostile")
    except ModuleNotFoundError as error:
        if error.name != "hostile":
            raise
        print("code: left out, for there is no tests/hostile.py")
        return None
    finally:
        sys.path.remove(str(TESTS))
    bad: list[str] = []
    found = Tally("code", f"--seed {seed}")
    for (_, outcome), number in hostile.run_hostile(count, seed, bad).items():
        found.counts[outcome] += number
    for text in bad[:20]:
        print(f"code: {text}\n")
    return found
