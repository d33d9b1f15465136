"""Handover matrices and chains, by hand and against episodes that are played."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from call_logs.logs import log_of

from skillweave.calls import CallLog, held
from skillweave.calls.handover import Handover, _chance_of_fewer, wilson
from skillweave.errors import DeclarationError, RunError

A, B = 0, 1


@pytest.fixture(scope="module")
def log() -> CallLog:
    return log_of(
        ["go", "stay"],
        [
            (0, [(A, [1, 2], True, "own"), (B, [2, 2], True, "limit"), (A, [3], True, "end")]),
            (0, [(A, [1, 2], True, "own"), (B, [2, 4], False, "limit"), (A, [5], False, "limit")]),
            (1, [(B, [1, 1, 1, 1], True, "limit"), (B, [9, 9], False, "cut")]),
            (1, [(A, [1], False, "limit"), (A, [2], True, "own"), (A, [3] * 4, True, "cut")]),
        ],
    )


def test_the_matrix_by_hand(log):
    matrix = log.handover()
    assert matrix.before == ("start", "go", "stay")
    # After "go": B won, B lost, A won (though the limit came then). After a lost call: nothing.
    assert matrix.calls.tolist() == [[3, 1], [1, 2], [1, 0]]
    assert matrix.done.tolist() == [[2, 1], [1, 1], [1, 0]]
    # The second "stay" of the third episode began 2 steps before its limit, and another has 4.
    assert matrix.began_late.tolist() == [[0, 0], [0, 0], [0, 1]]
    assert (matrix.time_limit, matrix.needed[2, 1]) == (6, 8)
    assert matrix.of("stay", after="go") == (0.5, 2)
    assert np.isnan(matrix.rate[2, 1])
    any_end = log.handover(only_after_done=False)
    assert any_end.calls.tolist() == [[3, 1], [2, 2], [2, 0]]
    assert any_end.done.tolist() == [[2, 1], [2, 1], [1, 0]]


def test_done_may_be_an_event_inside_the_call(log):
    def at_two(obs):
        return obs[:, 0] == 2

    # "stay" is done where two steps in succession end at 2, "go" where one does.
    matrix = log.handover({"stay": held(at_two, 2), "go": at_two})
    assert matrix.calls.tolist() == [[3, 1], [1, 2], [1, 0]]
    assert matrix.done.tolist() == [[2, 0], [0, 1], [0, 0]]
    assert not matrix.began_late.any()  # no call of "stay" was done before it


def test_intervals_and_fishers_test():
    low, high = wilson([0, 5, 10, 0], [10, 10, 10, 0])
    # By Wilson's formula with 1.96, worked out elsewhere.
    np.testing.assert_allclose(low, [0, 0.2366, 0.7225, 0], atol=1e-3)
    np.testing.assert_allclose(high, [0.2775, 0.7634, 1, 1], atol=1e-3)
    # The lady tasting tea: 8 cups, 4 of each kind, all right or one wrong.
    assert _chance_of_fewer(0, 4, 4, 4) == pytest.approx(1 / 70)
    assert _chance_of_fewer(1, 4, 3, 4) == pytest.approx(17 / 70)
    assert _chance_of_fewer(4, 4, 4, 4) == pytest.approx(1.0)


def walks(episodes: int, seed: int) -> CallLog:
    """Walks on a line: "there" goes from 0 to about 1 or 2; "on" succeeds from 2 alone."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(episodes):
        first = float(rng.integers(2))  # it starts at 0 or 1, and "there" adds one
        here, calls = first, []
        for _ in range(3):
            skill = int(rng.integers(3))
            if skill == 0:
                here = min(here + 1, 3)
                calls.append((0, [here + rng.normal(0, 0.01)], True, "own"))
            elif skill == 1:
                won = here == 2
                calls.append((1, [here], won, "own" if won else "limit"))
            else:
                here = 0.0
                calls.append((2, [here], True, "own"))
        found.append((first, calls))
    return log_of(["there", "on", "back"], found)


def test_a_chain_follows_where_calls_end():
    log = walks(600, 0)
    # "on" after "there": from 0 it ends at 1 and fails, from 1 at 2 and succeeds.
    estimate = log.chain("there", "on")
    first = (log.order == 0) & (log.skill == 0)
    assert abs(estimate.estimate - (log.start[first] == 1).mean()) < 0.02
    # After "back" it is at 0: the second "there" ends at 1, where "on" never succeeds.
    broken = log.chain("back", "there", "on")
    assert broken.estimate < 0.02
    assert broken.product > 0.2
    assert broken.rates[1:] == (
        log.handover().of("there", "back")[0], log.handover().of("on", "there")[0],
    )  # fmt: skip
    assert broken.calls[2] == log.handover().of("on", "there")[1]
    sure = log.chain("back", "there", "there", "on")
    assert sure.estimate > 0.98


def test_the_broken_handover_is_named():
    sentences = walks(600, 1).handover().weakest()
    assert any(
        re.match(r"'on' succeeds in 0% of \d+ calls \(.*\) after 'back'; in", s) for s in sentences
    )
    assert not any(s.startswith("'there'") for s in sentences)


def test_a_skill_that_is_never_done_is_the_weakest():
    def never(calls: int, judged: bool = True) -> Handover:
        episode = (0, [(A, [1], True, "own"), (B, [2], False, "limit")])
        return replace(
            log_of(["go", "stay"], [episode] * calls), own_success=(True, judged)
        ).handover()

    assert never(20).weakest() == [
        "'stay' succeeds in 0% of 20 calls (0% to 16%), whatever came before"
    ]
    assert never(20).weak() == [(1, 1)]
    assert "0% of 5 calls (0% to 43%)" in never(5).weakest()[0]
    assert not never(4).weakest()  # too few
    assert not never(20, judged=False).weakest()  # perhaps it only ends at its limit


def matrix(rates: dict[tuple[int, int], tuple[int, int]], skills: int = 2, **how) -> Handover:
    """A matrix with (done, calls) of some pairs."""
    calls, done = (np.zeros((skills + 1, skills), np.int64) for _ in range(2))
    for place, (did, count) in rates.items():
        calls[place], done[place] = count, did
    names = tuple("abcdefgh"[:skills])
    late = how.pop("began_late", np.zeros_like(calls))
    return Handover(names, calls, done, late, **how)


def test_a_pair_with_few_calls_is_weak_where_chance_does_not_explain_it():
    def weakest(did: int, count: int, elsewhere: int = 40) -> list[str]:
        return matrix({(1, 1): (did, count), (0, 1): (elsewhere, 40), (0, 0): (40, 40)}).weakest()

    assert weakest(0, 14) == [
        "'b' succeeds in 0% of 14 calls (0% to 22%) after 'a'; in 100% of 40 calls (91% to 100%) "
        "elsewhere"
    ]
    assert weakest(14, 14) == weakest(3, 3) == []
    assert (
        "Too few calls to say whether a handover is weak: 'b' after 'a' (67% of 3"
        in (weakest(2, 3)[0])
    )
    assert not weakest(2, 3, 28)  # as elsewhere, about
    assert not weakest(960, 1000)  # good enough, though clearly less than 100 %
    assert weakest(600, 1000)


def test_noise_is_seldom_called_weak():
    rng, alarms = np.random.default_rng(0), 0
    for _ in range(200):
        calls = rng.integers(20, 60, (6, 5))
        done = rng.binomial(calls, rng.uniform(0.3, 0.95, 5))
        alarms += bool(Handover(tuple("abcde"), calls, done, calls * 0).weakest())
    assert alarms <= 6  # of 200; one in a hundred is allowed for


def test_few_calls_say_how_many_steps_it_takes():
    found = matrix({(1, 1): (2, 4), (0, 1): (40, 40), (0, 0): (40, 40)}, steps=3_000).weakest()
    assert "with about 15,000 logged steps, in place of 3,000, each has 20" in found[0]


def test_pairs_without_time_are_named():
    late = np.array([[0, 0], [0, 78], [0, 0]])
    needed = np.array([[0, 0], [0, 200], [0, 0]])
    found = matrix(
        {(0, 0): (40, 40), (0, 1): (40, 40)}, began_late=late, needed=needed, time_limit=105
    )
    words = "episodes of about 200 steps, in place of 105, or shorter calls"
    assert f"'b' after 'a' (0 of 78 calls); that takes {words}" in found.weakest()[0]
    assert words in str(found)
    few = matrix(
        {(0, 0): (40, 40), (1, 1): (40, 40)}, began_late=late // 4, needed=needed, time_limit=105
    )
    assert few.weakest() == []
    assert "19 calls." in str(few)


def test_a_skill_that_is_seldom_done_is_named():
    found = matrix({(0, 0): (40, 40), (0, 1): (0, 30), (1, 1): (2, 30)}).weakest()
    assert found == ["'b' succeeds in only 3% of 60 calls (1% to 11%) in all"]


def test_a_chain_has_an_interval_that_holds_the_truth():
    """``on`` is done after ``there`` from 1 alone, which is half of the starts."""
    holds, widths = 0, list[float]()
    for seed in range(40):
        chain = walks(40, seed).chain("there", "on")
        low, high = chain.interval
        holds += low <= 0.5 <= high
        widths.append(high - low)
    assert holds >= 36
    assert 0.2 < np.mean(widths) < 0.8
    narrow = walks(2_000, 0).chain("there", "on").interval
    assert narrow[1] - narrow[0] < 0.12


def test_a_call_does_not_forecast_itself():
    """The nearest call to each end would be the one that followed it."""
    episodes = []
    for place, won in ((0.0, True), (1.0, True), (5.0, False)):
        calls = [(A, [place], True, "own"), (B, [place], won, "own" if won else "limit")]
        episodes.append((0.5, calls))
    log = log_of(["a", "b"], episodes)
    # From 0 and 1 the others are done in 5 of 6 and 4 of 5, by distance; from 5 in both.
    assert log.chain("a", "b").estimate == pytest.approx((5 / 6 + 4 / 5 + 1) / 3, abs=0.02)
    # Where there is no other call, it is all that is known: one call.
    assert log.take(np.arange(2)).chain("a", "b").interval == (
        pytest.approx(wilson(1, 1)[0]), 1.0,
    )  # fmt: skip


def test_it_is_shown_as_a_table_and_says_what_counts_without_a_success(log):
    matrix = log.handover()
    lines = str(matrix).splitlines()
    assert lines[0].split() == ["after", "go", "stay"]
    assert lines[2].split("  ")[-1].strip() == "50% of 2 (9% to 91%)"
    assert lines[3].split()[-1] == "-"
    assert "<table>" in matrix._repr_html_()
    assert matrix.by_itself == ()
    assert "A call is done if it succeeded." in str(matrix)
    assert str(matrix).endswith("time limit of 6 steps: 1 call.")
    assert "time limit" not in replace(log, known_time_limit=0).handover().left_out
    some = replace(log, own_success=(True, False))
    assert "without success() (stay) if it ended by itself." in str(some.handover())
    none = replace(log, own_success=(False, False)).handover()
    assert "<p>No success() is known: a call is" in none._repr_html_()
    broken = replace(walks(600, 1), own_success=(False,) * 3).handover().weakest()
    assert any("ends by itself in" in sentence for sentence in broken)


def test_sentences_of_chains_and_ends(log):
    assert str(log.chain("go")) == (
        "go: 67% (21% to 94%) along the logged calls; 67% as the product 67% of 3"
    )
    assert " then on: " in str(walks(60, 0).chain("back", "there", "on"))
    assert "no product, as no logged call of 'stay' came right after and counts" in str(
        log.chain("stay", "stay")
    )
    assert str(log.call_ends("stay")) == (
        "stay: 4 calls of 2.5 steps, of which 50% succeeded; ends: own 0%, limit 75%, "
        "interrupted 0%, episode 25%"
    )
    assert log.call_ends("stay").quantiles[1].tolist() == [3.0]


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda log: log.handover({"sty": len}), DeclarationError, "is 'stay' meant"),
        (lambda log: log.handover({"go": 3}), DeclarationError, "done of 'go': 3 is no pred"),
        (lambda log: log.handover(3), DeclarationError, "done is 3; it must be a dict"),
        (lambda log: log.handover().of("go", "x"), DeclarationError, "no skill 'x'"),
        (lambda log: log.chain(), DeclarationError, "needs the names of skills"),
        (lambda log: log.chain("go", "gone"), DeclarationError, "no skill 'gone'"),
        (
            lambda log: log.take(np.array([1, 2])).chain("go", "stay"),
            RunError,
            "no call of 'go' at the start of an episode that counts; record",
        ),
        (lambda log: log.of("go").call_ends("stay"), RunError, "no call of 'stay'"),
        (
            lambda log: replace(log, start=log.start * 0, next_obs=log.next_obs * 0).chain("go"),
            DeclarationError,
            "all features of skill 'go' are constant",
        ),
        (
            lambda log: replace(log, may_follow=log.may_follow & [True, False]).chain("go", "stay"),
            RunError,
            "'stay' may not start where any logged call of 'go'",
        ),
    ],
)
def test_wrong_arguments_of_handover(log, make, kind, message):
    with pytest.raises(kind, match=message):
        make(log)
