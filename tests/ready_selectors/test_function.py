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
    hierarchy,
    story,
)

from skillweave.errors import SkillError


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


WRONG = {
    "a number out of range": (lambda obs: np.full(len(obs), 4), r"returned 4, which is no action"),
    "it changes its argument": (lambda obs: obs.sort(), "change a copy"),
    "a wrong shape": (lambda obs: np.zeros((len(obs), 1), int), r"returned shape \(1, 1\)"),
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
    with pytest.raises(SkillError, match=rf"selector: function <lambda>\(\).*{message}"):
        story(hierarchy(function), 0)
