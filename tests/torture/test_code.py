"""The part of hostile user code counts what tests/hostile.py tells."""

import sys
from collections import Counter
from types import SimpleNamespace

import pytest

from scripts.torture.code import tally

pytestmark = pytest.mark.slow


def test_many_are_drawn_in_portions_each_with_a_seed_of_its_own(monkeypatch, capsys):
    drawn = []

    def run_hostile(examples, seed, bad):
        drawn.append((examples, seed))
        bad.extend(["Case(y)\nTraceback"] if seed == 5 else [])
        wrong = {("env", "TRACEBACK"): 1} if seed == 5 else {}
        return Counter({("reward", "refused"): 5, ("env", "refused"): 3} | wrong)

    monkeypatch.setitem(sys.modules, "hostile", SimpleNamespace(run_hostile=run_hostile))
    found = tally(2_300, 4)
    assert (found.counts, found.bad) == ({"refused": 24, "TRACEBACK": 1}, 1)
    assert drawn == [(1_000, 4), (1_000, 5), (300, 6)]
    assert "--seed 5: Case(y)" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "hostile", None)  # an import of it fails
    assert tally(9, 4) is None
    assert "left out" in capsys.readouterr().out
