"""A seeded part of the hostile cases; ``hostile.run_hostile`` takes as many as wanted."""

import numpy as np
import pytest
from hostile import Case, run_hostile, train, tried

from skillweave import Skill
from skillweave.errors import SkillweaveError


@pytest.mark.slow
def test_every_hostile_case_is_a_sentence_or_does_no_harm():
    bad: list[str] = []
    counts = run_hostile(40, 0, bad)
    assert bad == []
    assert sum(counts.values()) == 40
    assert sum(n for (_, outcome), n in counts.items() if outcome == "sentence") > 20


def test_the_trial_sees_what_is_wrong():
    def case(play, names=("who",)):
        return tried(Case("x", "y", names, play))[0]

    def sentence(_):
        raise SkillweaveError("who did it")

    def other(_):
        raise ValueError("no")

    assert case(sentence) == "sentence"
    assert case(sentence, ("someone else",)) == "UNNAMED"
    assert case(other) == "TRACEBACK"
    assert case(lambda _: None) == "accepted"


@pytest.mark.slow
def test_what_the_hostile_cases_start_from_is_in_order(tmp_path):
    train(tmp_path)
    with pytest.raises(SkillweaveError, match=r"skill 'bad': reward.. returned nan"):
        train(tmp_path / "bad", skills=[Bad()])


class Bad(Skill):
    def reward(self, step):
        return np.full(len(step.reward), np.nan)
