"""Automata as selectors, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ready_selectors.chain import bound, got_key, hierarchy, story

from skillweave import Automaton
from skillweave.errors import DeclarationError, SkillError
from skillweave.types import Step

STATES = {"search": "get_key", "unlock": "open_door", "free": "leave"}
ARROWS = {("search", "unlock"): got_key, ("unlock", "free"): "success"}


def test_greedy_the_first_is_called_and_else_one_at_random():
    in_order = bound(Automaton({"x": ["wait", "get_key", "leave"]}, {}))
    of_a_set = bound(Automaton({"x": {"wait", "get_key", "leave"}}, {}))
    n, obs = 3000, np.zeros((3000, 3), np.float32)
    mask = np.ones((n, 4), bool)
    mask[1::3, 0], mask[2::3, [0, 3]] = False, False
    for policy, first in ((in_order, [3, 3, 2]), (of_a_set, [0, 2, 2])):
        skill, _ = policy.act(policy.start(n), obs, mask)
        assert skill.tolist() == first * 1000
    skill, _ = in_order.act(
        in_order.start(n), obs, mask, deterministic=False, rng=np.random.default_rng(0)
    )
    assert mask[np.arange(n), skill].all()
    assert set(skill[::3]) == {0, 2, 3}
    counts = np.bincount(skill[::3], minlength=4)
    assert (np.abs(counts[[0, 2, 3]] - 333) < 60).all()  # four standard deviations
    assert set(skill[1::3]) == {2, 3}
    assert set(skill[2::3]) == {2}


def test_an_automaton_whose_skills_may_not_start_says_so():
    policy = hierarchy(Automaton({"all": {"open_door"}}, {}))
    with pytest.raises(SkillError, match=r"state 'all' none of its skills \(open_door\).*init"):
        story(policy, 0)
    # The others of a state are called instead.
    policy = hierarchy(Automaton({"all": ["open_door", "wait"]}, {}))
    assert story(policy, 0)[0] == ("wait", 2)


def test_an_event_that_answers_wrongly_is_named():
    def won(step: Step) -> Any:
        return step.next_obs

    automaton = Automaton(STATES, {("search", "free"): won})
    with pytest.raises(SkillError, match=r"automaton: won\(\) returned shape \(1, 3\)"):
        story(hierarchy(automaton), 0)
    automaton = Automaton(STATES, {("search", "free"): lambda step: step.info["nothing"]})
    with pytest.raises(SkillError, match="KeyError: 'nothing'"):
        story(hierarchy(automaton), 0)


def test_its_checksum_is_of_its_structure():
    def source(*arguments: Any) -> str:
        return Automaton(*arguments).source()["sha256"]

    assert source(STATES, ARROWS) == source(dict(STATES), dict(ARROWS))
    others = [
        source(STATES, ARROWS, "free"),
        source(STATES | {"free": "wait"}, ARROWS),
        source(STATES | {"free": ["leave", "wait"]}, ARROWS),
        source(STATES | {"free": {"leave", "wait"}}, ARROWS),
        source(STATES, ARROWS | {("free", "search"): "failure"}),
        source(STATES, dict(reversed(ARROWS.items()))),
    ]
    assert len({source(STATES, ARROWS), *others}) == len(others) + 1


def test_a_subclass_with_a_method_that_would_not_be_asked_is_refused():
    with pytest.raises(DeclarationError, match=r"Never\.watch\(\) would not be asked"):

        class Never(Automaton):
            def watch(self, memory, step, last):
                return memory
