"""Guides that decide, and the probabilities that collectors keep; tests/calls has the rest."""

from __future__ import annotations

import numpy as np
import pytest
from ready_selectors.chain import KEY, SPEC, GetKey, Leave, OpenDoor, Wait, bound, got_key
from toy_acting import Choices, requests
from toys import calling_in, skills_of

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import make_engine
from skillweave.experience.acting import Acted
from skillweave.experience.collector import joined_collected
from skillweave.experience.decisions import SMOOTHED, as_logits
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.skills import Automaton

N = 3
SKILLS = (GetKey(), OpenDoor(), Leave(), Wait())
AUTOMATON = Automaton(
    {"search": {"get_key", "wait"}, "unlock": ["wait", "open_door"], "free": "leave"},
    {("search", "unlock"): got_key, ("unlock", "free"): "success"},
)


def collector_of(guide, call_steps=2):
    skills = skills_of(*SKILLS, call_steps=call_steps)
    acting = Choices(N, skills.choices)
    found = calling_in(make_engine(SPEC, N), acting, skills, guide=guide)
    found.start(Seeds(2))
    return found


def test_a_guide_that_decides_takes_any_of_several_and_the_first_if_it_is_greedy():
    skills = skills_of(*SKILLS, call_steps=2)
    for greedy in (False, True):
        collector = calling_in(
            make_engine(SPEC, N), None, skills,
            guide=ActiveGuide(bound(AUTOMATON), decides=True),
        )  # fmt: skip
        collector.start(Seeds(2))
        request = next(requests(80))
        request = type(request)(80, (), request.gamma, request.seeds, greedy=greedy)
        collector.log_calls = ()
        found = collector.collect(request).calls
        starts = found["call_elapsed"] == 1
        taken = set(np.unique(found["skill"][starts & (found["obs"][..., KEY] == 0)]).tolist())
        assert taken == ({0} if greedy else {0, 3})


def test_logits_are_smoothed_among_what_is_allowed():
    chances = np.float32([[1, 0, 0], [0.5, 0.5, 0]])
    may = np.array([[True, True, False], [True, True, True]])
    found = np.exp(as_logits(chances, may))
    assert found[0].tolist() == pytest.approx([1 - SMOOTHED / 2, SMOOTHED / 2, 0], abs=1e-6)
    assert found[1].tolist() == pytest.approx(
        [(1 - SMOOTHED) / 2 + SMOOTHED / 3] * 2 + [SMOOTHED / 3]
    )


@pytest.mark.parametrize("tells", [False, True])
def test_collectors_agree_on_what_they_tell_also_where_no_call_has_ended(tells):
    found = []
    for call_steps, rows in ((30, 1), (1, 2)):
        collector = collector_of(ActiveGuide(bound(AUTOMATON), tells=tells), call_steps)
        if rows == 1:  # it waits for two steps
            collector.acting.some = lambda ids, *seen: Acted(np.full(len(ids), 3), None, None)
        found.append(collector.collect(next(requests(rows))))
    assert not found[0].batches[""]["valid"].any(), "no call has ended"
    joined = joined_collected(found, 1).batches[""]
    assert ("guide" in joined) == tells
    assert joined.lead[1] == 2 * N
