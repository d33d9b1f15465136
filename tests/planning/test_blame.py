"""Which of two skills is to blame, in logs whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from logs import log_of

from skillweave.errors import RunError
from skillweave.planning import Blame, CallLog

A, B = 0, 1


def log(works: str, calls: int = 120) -> CallLog:
    """Skill a ends between 0 and 1; b, called after it, works ``never`` or where it ended "low"."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(calls):
        end = float(rng.random())
        won = {"never": False, "always": True, "low": end < 0.4}[works]
        b = (B, [end, end], won, "own" if won else "limit")
        episodes.append((5.0, [(A, [3.0, end], True, "own"), b]))
        episodes.append((5.0, [(B, [4.0, 2.0], True, "own")]))
    return log_of(["a", "b"], episodes)


def test_the_first_is_to_blame_where_other_ends_of_it_would_do():
    found = log("low").blame("b", "a")
    assert found.first
    assert found.best > 0.9
    assert found.others < 0.3
    assert (found.place, found.elsewhere) == (0, 1.0)
    assert found.means[0] < 0.4 < found.means[1]
    assert "'a' is to blame for where it ends: from the best third of its ends" in str(found)
    assert "(number 0 of the observation is" in str(found)
    assert "100% reached their limit of steps" in str(found)


def test_the_second_must_learn_where_no_end_would_do():
    found = log("never").blame("b", "a")
    assert not found.first
    assert (found.rate, found.calls) == (0.0, 120)
    assert "It would not help if 'a' ended elsewhere" in str(found)
    assert str(found).endswith("So 'b' itself has to work from there.")


@pytest.mark.parametrize(
    ("decides", "elsewhere", "first"),
    [("end", False, True), ("key", False, False), ("place", True, True)],
)
def test_only_what_the_first_skill_changes_is_held_against_it(decides, elsewhere, first):
    """Number 1 is fixed in an episode; a ends anywhere ("end"), or at the place of that number.

    Where b also starts elsewhere, its calls show that the place decides, not the number.
    """
    rng, episodes = np.random.default_rng(0), []
    for key in rng.random(120):
        end = rng.random() if decides == "end" else key
        won = bool(end < 0.4)
        b = (B, [[end, key]], won, "own" if won else "limit")
        episodes.append(([5.0, key], [(A, [[3.0, key], [end, key]], True, "own"), b]))
        if elsewhere:
            episodes.append(([end * 0.4, key], [(B, [[end, key]], True, "own")]))
    found = log_of(["a", "b"], episodes, size=2).blame("b", "a")
    assert (found.first, found.place) == (first, 0)
    assert f"in {found.rate:.0%} of 120 calls (" in str(found)


def test_none_is_to_blame_where_it_works():
    found = log("always").blame("b", "a")
    assert found.fine
    assert "neither skill is to blame" in str(found)
    assert log("never").blame("b", "start").fine


def test_an_event_judges_in_place_of_success():
    found = log("never").blame("b", "a", done={"b": lambda obs: obs[:, 0] < 0.4})
    assert found.first


def test_few_calls_do_not_tell():
    found = log("never", 8).blame("b", "a")
    assert np.isnan(found.best)
    assert "too few calls to say which skill is to blame" in str(found)


def test_a_pair_without_a_call_is_said():
    with pytest.raises(RunError, match="no call of 'a' after a call of 'b'"):
        log("low").blame("a", "b")


@pytest.mark.parametrize("calls", [44, 45, 124])
def test_a_skill_that_is_always_done_is_to_blame_for_nothing(calls):
    nan, reasons = float("nan"), {"own": 0, "limit": 0, "interrupted": 0, "episode": 0}
    found = Blame("b", "a", 1.0, 1.0, calls, 9, 1.0, 1.0, None, (nan, nan), reasons, False)
    assert "neither skill is to blame" in str(found)
