"""Hand-over matrices and chains, by hand and against episodes that are played."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planning.logs import log_of

from skillweave.errors import DeclarationError, RunError
from skillweave.planning import CallLog, call_ends, chain, hand_over, held
from skillweave.planning.hand_over import wilson

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


def test_the_matrix_by_hand(log: CallLog) -> None:
    matrix = hand_over(log)
    assert matrix.before == ("start", "go", "stay")
    # After "go": B won, B lost, A won (though the limit came then). After a lost call: nothing.
    assert matrix.calls.tolist() == [[3, 1], [1, 2], [1, 0]]
    assert matrix.done.tolist() == [[2, 1], [1, 1], [1, 0]]
    assert matrix.cut.tolist() == [0, 1]
    assert matrix.of("stay", after="go") == (0.5, 2)
    assert np.isnan(matrix.rate[2, 1])
    any_end = hand_over(log, only_after_done=False)
    assert any_end.calls.tolist() == [[3, 1], [2, 2], [2, 0]]
    assert any_end.done.tolist() == [[2, 1], [2, 1], [1, 0]]


def test_done_may_be_an_event_inside_the_call(log: CallLog) -> None:
    def at_two(obs: Any) -> Any:
        return obs[:, 0] == 2

    # "stay" is done where two steps in succession end at 2, "go" where one does.
    matrix = hand_over(log, {"stay": held(at_two, 2), "go": at_two})
    assert matrix.calls.tolist() == [[3, 1], [0, 2], [1, 0]]
    assert matrix.done.tolist() == [[2, 0], [0, 1], [0, 0]]
    assert matrix.cut.tolist() == [1, 1]


def test_intervals() -> None:
    low, high = wilson([0, 5, 10, 0], [10, 10, 10, 0])
    # By Wilson's formula with 1.96, worked out elsewhere.
    np.testing.assert_allclose(low, [0, 0.2366, 0.7225, 0], atol=1e-3)
    np.testing.assert_allclose(high, [0.2775, 0.7634, 1, 1], atol=1e-3)


def test_it_is_shown_as_a_table(log: CallLog) -> None:
    lines = str(hand_over(log)).splitlines()
    assert lines[0].split() == ["after", "go", "stay"]
    assert lines[2].split() == ["go", "100%", "(1)", "50%", "(2)"]
    assert lines[3].split()[-1] == "–"
    assert "<table>" in hand_over(log)._repr_html_()


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


def test_a_chain_follows_where_calls_end() -> None:
    log = walks(600, 0)
    # "on" after "there": from 0 it ends at 1 and fails, from 1 at 2 and succeeds.
    estimate = chain(log, "there", "on")
    first = (log.order == 0) & (log.skill == 0)
    assert abs(estimate.estimate - (log.start[first] == 1).mean()) < 0.02
    # After "back" it is at 0: the second "there" ends at 1, where "on" never succeeds.
    broken = chain(log, "back", "there", "on")
    assert broken.estimate < 0.02
    assert broken.product > 0.2
    assert broken.rates[1:] == (
        hand_over(log).of("there", "back")[0], hand_over(log).of("on", "there")[0],
    )  # fmt: skip
    assert broken.calls[2] == hand_over(log).of("on", "there")[1]
    sure = chain(log, "back", "there", "there", "on")
    assert sure.estimate > 0.98


def test_the_broken_hand_over_is_named() -> None:
    sentences = hand_over(walks(600, 1)).weakest()
    assert any(s.startswith("'on' succeeds in 0% of the calls after 'back'; ") for s in sentences)
    assert not any(s.startswith("'there'") for s in sentences)


def test_where_calls_end(log: CallLog) -> None:
    ends = call_ends(log, "stay")
    assert ends.reasons == {"own": 0, "limit": 3, "interrupted": 0, "episode": 1}
    assert ends.calls == 4
    assert ends.steps == pytest.approx(9 / 4)
    assert ends.succeeded == 0.5
    assert ends.quantiles[1].tolist() == [3.0]


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda log: hand_over(log, {"sty": len}), DeclarationError, "Close matches: stay"),
        (lambda log: hand_over(log, {"go": 3}), DeclarationError, "done of 'go': 3 is no pred"),
        (lambda log: hand_over(log, 3), DeclarationError, "give events by skill"),
        (lambda log: hand_over(log).of("go", "x"), DeclarationError, "no skill 'x'"),
        (lambda log: chain(log), DeclarationError, "needs the names of skills"),
        (lambda log: chain(log, "go", "gone"), DeclarationError, "no skill 'gone'"),
        (
            lambda log: chain(log.take(np.array([1, 2])), "go", "stay"),
            RunError,
            "no complete call of 'go' at the start of an episode",
        ),
        (lambda log: call_ends(log.of("go"), "stay"), RunError, "no call of 'stay'"),
        (
            lambda log: chain(replace(log, start=log.start * 0, next_obs=log.next_obs * 0), "go"),
            DeclarationError,
            "all features of skill 'go' are constant",
        ),
    ],
)
def test_wrong_arguments_of_hand_over(log: CallLog, make: Any, kind: Any, message: str) -> None:
    with pytest.raises(kind, match=message):
        make(log)
