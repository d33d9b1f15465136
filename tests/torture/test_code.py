"""The part of hostile user code counts what tests/hostile.py tells."""

import sys
from collections import Counter
from types import SimpleNamespace

import pytest

from scripts.torture.code import tally

pytestmark = pytest.mark.slow


def test_outcomes_are_counted_over_all_categories(monkeypatch, capsys):
    def run_hostile(examples, seed, bad):
        assert (examples, seed) == (9, 4)
        bad.append("Case(x)\nTraceback")
        return Counter({("reward", "refused"): 5, ("env", "refused"): 3, ("env", "TRACEBACK"): 1})

    monkeypatch.setitem(sys.modules, "hostile", SimpleNamespace(run_hostile=run_hostile))
    found = tally(9, 4)
    assert found.counts == {"refused": 8, "TRACEBACK": 1}
    assert found.bad == 1
    assert "Case(x)" in capsys.readouterr().out


def test_many_are_drawn_in_portions_each_with_a_seed_of_its_own(monkeypatch, capsys):
    drawn = []

    def run_hostile(examples, seed, bad):
        drawn.append((examples, seed))
        bad.extend(["Case(y)"] if seed == 5 else [])
        return Counter({("env", "refused"): examples})

    monkeypatch.setitem(sys.modules, "hostile", SimpleNamespace(run_hostile=run_hostile))
    assert tally(2_300, 4).counts == {"refused": 2_300}
    assert drawn == [(1_000, 4), (1_000, 5), (300, 6)]
    assert "--seed 5: Case(y)" in capsys.readouterr().out


def test_without_the_module_the_part_is_left_out_and_says_so(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "hostile", None)  # an import of it fails
    assert tally(9, 4) is None
    assert "left out" in capsys.readouterr().out
