"""Hostile user code and environments: the cases themselves are tests/hostile.py's."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from scripts.torture.report import Tally

TESTS = Path(__file__).parents[2] / "tests"
PORTION = 1_000
"""Examples of one run of Hypothesis: 1,000 take two minutes, 10,000 more than 45."""


def tally(count: int, seed: int) -> Tally | None:
    """Return the counts of ``n`` examples, failures in capitals; None without tests/hostile.py.

    They are drawn in portions, whose seeds are ``seed``, ``seed + 1``, and so on.
    """
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
    found = Tally("code", f"--seed {seed}")
    for number, done in enumerate(range(0, count, PORTION), seed):
        bad: list[str] = []
        drawn = hostile.run_hostile(min(PORTION, count - done), number, bad)
        for (_, outcome), cases in drawn.items():
            found.counts[outcome] += cases
        for text in bad[:20]:
            print(f"code, --seed {number}: {text}\n")
    return found
