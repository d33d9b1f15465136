"""Which of two skills is to blame, in logs whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from call_logs.logs import log_of

from skillweave.calls import Blame, CallLog
from skillweave.errors import RunError

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
    assert "From the best third of the ends of 'a' it is done in 0% of 40 calls" in str(found)
    # It works from 5, where no call of "a" ends.
    assert found.works == (("start", 120, 120),)
    assert found.differs == (0, 5.0, 5.0, 1.0)
    assert "'b' works at the start of an episode (100% of 120 calls (97% to 100%))." in str(found)
    assert "number 0 of the observation is from 5 to 5 at the start; 100% of the" in str(found)
    assert str(found).endswith(
        "So 'b' itself has to work from there, another skill has to come in between, or 'a' has "
        "to end where 'b' works."
    )
    assert "So they may need more steps (call_steps, max_steps)" in str(found)


def test_without_another_start_the_second_skill_has_to_work_from_there():
    every = log("never")
    after = every.take(np.flatnonzero((every.start[:, 0] < 5) | (every.skill == A)))
    found = after.blame("b", "a")
    assert (found.works, found.differs, found.calls_elsewhere) == ((), None, 0)
    assert str(found).endswith("So 'b' itself has to work from there.")


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.3])
def test_ends_that_are_alike_do_not_say_whether_others_would_do(noise):
    """``a`` always ends at 1, where ``b`` fails; it works after ``c``, which ends at 0."""
    rng, episodes = np.random.default_rng(0), []
    for i in range(120):
        end = 1.0 + noise * float(rng.random()) if i % 2 else 0.0
        won = not i % 2
        b = (B, [end], won, "own" if won else "end")
        episodes.append((0.5, [(A if i % 2 else 2, [end], True, "own"), b]))
    found = log_of(["a", "b", "c"], episodes).blame("b", "a")
    assert found.alike == (noise < 0.1)
    assert ("All ends of 'a' are alike" in str(found)) == found.alike
    assert found.works == (("c", 60, 60),)
    assert "'b' works after 'c' (100% of 60 calls (94% to 100%)). Where" in str(found)
    assert found.differs == (0, 0.0, 0.0, 1.0)
    assert "would not help" not in str(found)
    assert "more steps" not in str(found)


@pytest.mark.parametrize("moves", [True, False])
def test_calls_that_stand_still_at_their_limit_need_no_more_steps(moves):
    rng, episodes = np.random.default_rng(0), []
    for _ in range(40):
        way = [float(rng.random()) + 0.1 * step * moves for step in range(8)]
        way = way if moves else way[:1] * 8
        episodes.append((5.0, [(A, [3.0, way[0]], True, "own"), (B, way, False, "limit")]))
    found = log_of(["a", "b"], episodes).blame("b", "a")
    assert found.stuck == (not moves)
    assert ("may need more steps" in str(found)) == moves
    assert ("Most stood still before it" in str(found)) == (not moves)


def test_the_number_that_divides_calls_is_named_though_the_means_are_alike():
    """``b`` works near 0 alone; ``a`` ends on both sides, and in any place of number 1."""
    rng, episodes = np.random.default_rng(0), []
    for i in range(200):
        end = [float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1))]
        if i % 2:
            end = [float(rng.uniform(-0.1, 0.1)), 0.3]
        won = abs(end[0]) < 0.1
        b = (B, [end], won, "own" if won else "limit")
        episodes.append(([5.0, 5.0], [(2 if i % 2 else A, [end], True, "own"), b]))
    found = log_of(["a", "b", "c"], episodes, size=2).blame("b", "a")
    place, low, high, outside = found.differs
    assert (place, outside) == (0, 1.0)
    assert -0.1 < low < high < 0.1


def test_what_the_first_skill_does_not_change_is_no_reason_to_end_elsewhere():
    """``b`` works with a key, which ``a`` cannot get: number 1 alone decides."""
    episodes = []
    for i in range(120):
        key, won = float(i % 2), bool(i % 2)
        b = (B, [[1.0, key]], won, "own" if won else "limit")
        episodes.append(([0.0, key], [(A if not won else 2, [[1.0, key]], True, "own"), b]))
    found = log_of(["a", "b", "c"], episodes, size=2).blame("b", "a")
    assert found.works == (("c", 60, 60),)
    assert found.differs is None
    assert str(found).endswith("work from there, or another skill has to come in between.")


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


def test_none_is_to_blame_where_it_works_and_an_event_judges_in_place_of_success():
    found = log("always").blame("b", "a")
    assert found.fine
    assert "neither skill is to blame" in str(found)
    assert log("never").blame("b", "start").fine
    assert log("never").blame("b", "a", done={"b": lambda obs: obs[:, 0] < 0.4}).first


def test_few_calls_do_not_tell():
    found = log("never", 8).blame("b", "a")
    assert np.isnan(found.best)
    assert "too few calls to say which skill is to blame" in str(found)
    assert "'b' works at the start of an episode (100% of 8 calls" in str(found)
    with pytest.raises(RunError, match="no call of 'a' after a call of 'b'"):
        log("low").blame("a", "b")


@pytest.mark.parametrize("calls", [44, 45, 124])
def test_a_skill_that_is_always_done_is_to_blame_for_nothing(calls):
    nan, reasons = float("nan"), {"own": 0, "limit": 0, "interrupted": 0, "episode": 0}
    found = Blame("b", "a", 1.0, 1.0, calls, 9, 1.0, 1.0, None, (nan, nan), reasons, False)
    assert "neither skill is to blame" in str(found)
