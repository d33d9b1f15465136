"""Handover matrices and chains, by hand and against episodes that are played."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from planning.logs import log_of

from skillweave.errors import DeclarationError, RunError
from skillweave.planning import CallLog, held
from skillweave.planning.handover import Handover, wilson

A, B = 0, 1


@pytest.fixture(scope="module")
def log() -> CallLog:
    return log_of(
        ["go", "stay"],
        [
            (0, [(A, [1, 2], True, "own"), (B, [2, 2, 2], True, "limit"), (A, [3], True, "end")]),
            (0, [(A, [1, 2], True, "own"), (B, [2, 4], False, "limit"), (A, [5], False, "limit")]),
            (1, [(B, [1, 1, 1], True, "limit"), (B, [9], False, "cut")]),
            (1, [(A, [1], False, "limit"), (A, [2], True, "own"), (A, [3], True, "cut")]),
        ],
    )


def test_the_matrix_by_hand(log):
    matrix = log.handover()
    assert matrix.before == ("start", "go", "stay")
    # After "go": B won, B lost, A won (though the limit came then). After a lost call: nothing.
    assert matrix.calls.tolist() == [[3, 1], [1, 2], [1, 0]]
    assert matrix.done.tolist() == [[2, 1], [1, 1], [1, 0]]
    assert matrix.cut.tolist() == [0, 1]
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
    assert matrix.calls.tolist() == [[3, 1], [0, 2], [1, 0]]
    assert matrix.done.tolist() == [[2, 0], [0, 1], [0, 0]]
    assert matrix.cut.tolist() == [1, 1]


def test_intervals():
    low, high = wilson([0, 5, 10, 0], [10, 10, 10, 0])
    # By Wilson's formula with 1.96, worked out elsewhere.
    np.testing.assert_allclose(low, [0, 0.2366, 0.7225, 0], atol=1e-3)
    np.testing.assert_allclose(high, [0.2775, 0.7634, 1, 1], atol=1e-3)


def test_it_is_shown_as_a_table(log):
    lines = str(log.handover()).splitlines()
    assert lines[0].split() == ["after", "go", "stay"]
    assert lines[2].split("  ")[-1].strip() == "50% of 2 (9% to 91%)"
    assert lines[3].split()[-1] == "-"
    assert "<table>" in log.handover()._repr_html_()


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
    assert not never(19).weakest()  # too few
    assert not never(20, judged=False).weakest()  # perhaps it only ends at its limit


def test_what_counts_without_a_success_is_said(log):
    matrix = log.handover()
    assert matrix.by_itself == ()
    assert str(matrix).endswith("A call is done if it succeeded.")
    some = replace(log, own_success=(True, False))
    assert str(some.handover()).endswith("without success() (stay) if it ended by itself.")
    none = replace(log, own_success=(False, False)).handover()
    assert "<p>No success() is known: a call is" in none._repr_html_()
    broken = replace(walks(600, 1), own_success=(False,) * 3).handover().weakest()
    assert any("ends by itself in" in sentence for sentence in broken)


def test_sentences_of_chains_and_ends(log):
    assert str(log.chain("go")) == ("go: 67% along the logged calls; 67% as the product 67% of 3")
    assert " then on: " in str(walks(60, 0).chain("back", "there", "on"))
    assert str(log.call_ends("stay")) == (
        "stay: 4 calls of 2.2 steps, of which 50% succeeded; ends: own 0%, limit 75%, "
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
            "no complete call of 'go' at the start of an episode",
        ),
        (lambda log: log.of("go").call_ends("stay"), RunError, "no call of 'stay'"),
        (
            lambda log: replace(log, start=log.start * 0, next_obs=log.next_obs * 0).chain("go"),
            DeclarationError,
            "all features of skill 'go' are constant",
        ),
    ],
)
def test_wrong_arguments_of_handover(log, make, kind, message):
    with pytest.raises(kind, match=message):
        make(log)


def test_a_chain_whose_next_skill_may_never_start_is_refused(log):
    may = log.may_follow.copy()
    may[log.skill == A, B] = False
    with pytest.raises(RunError, match=r"'stay' may not start where any logged call of 'go'"):
        replace(log, may_follow=may).chain("go", "stay")


def test_a_pair_without_a_call_has_no_product(log):
    assert "no product, as no logged call of 'stay' came right after" in str(
        log.chain("stay", "stay")
    )
