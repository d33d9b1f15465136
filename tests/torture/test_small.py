"""The small, seeded part of ``make torture``: every kind of case, a few of each."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("torture")
    command = [sys.executable, "-m", "scripts.torture", "--small", "--out", str(out)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def counts(text: str) -> dict[str, int]:
    """By category, the cases of all parts."""
    found = {}
    for line in text[text.index("\n\n") :].splitlines():
        *name, files, kills, disk = line.split() or ["", "", "", ""]
        if files.isdigit():
            found[" ".join(name)] = int(files) + int(kills) + int(disk)
    return found


def test_no_code_runs_nothing_crashes_and_no_weight_is_lost(done):
    found = counts(done.stdout)
    assert found["cases"] == 150 + 2 + 8, done.stdout + done.stderr
    assert found["as the original"] > 20
    assert found["a sentence"] > 20
    bad = {"CODE RUN", "CRASH", "LOST", "OTHER WEIGHTS", "PROCESSES LEFT"}
    assert not bad & found.keys(), done.stdout


def test_nothing_fails(done):
    assert done.returncode == 0, done.stdout + done.stderr
