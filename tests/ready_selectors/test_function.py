"""Functions as selectors, and how a call's success is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ready_selectors.chain import (
    DOOR,
    KEY,
    NAMES,
    Corridor,
    GetKey,
    Leave,
    Wait,
    bound,
    hierarchy,
    story,
)

from skillweave import LastCall, SkillweaveError
from skillweave.collecting.ends import CallEnd


def by_number(obs: Any) -> Any:
    return np.where(obs[:, DOOR] == 1, 2, obs[:, KEY].astype(int))


def by_name(obs: Any) -> Any:
    return [NAMES[i] for i in by_number(obs)]


def by_name_in_an_array(obs: Any) -> Any:
    return np.where(obs[:, DOOR] == 1, "leave", np.where(obs[:, KEY] == 1, "open_door", "get_key"))


@pytest.mark.parametrize("function", [by_number, by_name, by_name_in_an_array])
def test_numbers_and_names_choose_the_same(function):
    for seed in range(3):
        place = int(Corridor().reset(seed=seed)[0][0])
        wanted = [("get_key", place), ("open_door", 6), ("leave", 1)]
        assert story(hierarchy(function), seed) == wanted


@pytest.mark.usefixtures("unprobed")
def test_a_function_of_two_arguments_is_told_how_the_last_call_ended():
    told: list[tuple[int, int, bool]] = []

    def choose(obs: Any, last: LastCall) -> Any:
        told.append((int(last.skill[0]), int(last.why[0]), bool(last.succeeded[0])))
        # Wait once, then get the key until that succeeds, then open the door.
        return np.where(last.skill == -1, 3, np.where(last.succeeded & (last.skill == 0), 1, 0))

    place = int(Corridor().reset(seed=0)[0][0])
    assert place > 2
    calls = story(hierarchy(choose, call_steps=place - 1), 0, most=2 + place + 1)
    assert calls == [("wait", 2), ("get_key", place - 1), ("get_key", 1), ("open_door", 1)]
    assert told == [
        (-1, CallEnd.EPISODE, False),
        (3, CallEnd.LIMIT, False),
        (0, CallEnd.LIMIT, False),
        (0, CallEnd.OWN, True),
    ]


class Lucky(Wait):
    """Its own end never comes; success says when it has succeeded."""

    name = "lucky"

    def success(self, step: Any) -> Any:
        return step.elapsed == 2


class Unlucky(GetKey):
    """It ends by itself, and has not succeeded."""

    name = "unlucky"

    def success(self, step: Any) -> Any:
        return np.zeros(len(step.reward), bool)


def test_success_is_what_the_skill_says_else_its_own_end():
    seen: dict[str, bool] = {}
    skills = (GetKey(), Wait(), Lucky(), Unlucky(), Leave())
    names = [s.name for s in skills]

    def choose(obs: Any, last: LastCall) -> Any:
        if last.skill[0] >= 0:
            seen[names[int(last.skill[0])]] = bool(last.succeeded[0])
        return last.skill + 1 if last.skill[0] < 4 else last.skill

    story(hierarchy(choose, skills=skills), 0, most=20)
    assert seen == {
        "get_key": True,
        "wait": False,
        "lucky": True,
        "unlucky": False,
        "leave": False,
    }


WRONG = {
    "a number out of range": (lambda obs: np.full(len(obs), 4), r"returned 4, which is no action"),
    "a negative number": (lambda obs: np.full(len(obs), -1), "returned -1"),
    "a wrong shape": (lambda obs: np.zeros((len(obs), 1), int), r"returned shape \(1, 1\)"),
    "one name": (lambda obs: "get_key", r"returned shape \(\)"),
    "fractions": (lambda obs: np.zeros(len(obs)), "returned float64"),
    "no skill's name": (lambda obs: ["walk"] * len(obs), "names 'walk', which is no skill"),
    "None": (lambda obs: [None] * len(obs), "names None, which is no skill"),
    "an error": (lambda obs: obs[:, 99], "IndexError"),
    "one that may not start": (
        lambda obs: ["open_door"] * len(obs),
        r"chose skill 'open_door' in observation \[.*initiation\(\) is False there; choose.*"
        "get_key, leave, wait",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_choice_is_refused_with_the_functions_name(case):
    function, message = WRONG[case]
    with pytest.raises(SkillweaveError, match=rf"selector: function <lambda>\(\).*{message}"):
        story(hierarchy(function), 0)


def test_a_function_is_given_what_it_cannot_change():
    def choose(obs: Any) -> Any:
        obs[:] = 0
        return [0]

    with pytest.raises(SkillweaveError, match="change a copy"):
        story(hierarchy(choose), 0)
    with pytest.raises(SkillweaveError, match="change a copy"):
        bound(choose).try_out()
