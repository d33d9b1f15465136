"""The small, seeded part of ``make torture``: every kind of case, a few of each."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def counts(text: str) -> dict[str, int]:
    """By category, the cases of all parts."""
    found = {}
    for line in text[text.index("\n\n") :].splitlines():
        *name, files, kills, disk = line.split() or ["", "", "", ""]
        if files.isdigit():
            found[" ".join(name)] = int(files) + int(kills) + int(disk)
    return found


def test_all_kinds_of_cases_are_tried_and_nothing_fails(tmp_path):
    command = [sys.executable, "-m", "scripts.torture", "--small", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = counts(done.stdout)
    assert found["cases"] == 150 + 2 + 8, done.stdout + done.stderr
    assert found["as the original"] > 20
    assert found["a sentence"] > 20
