"""Paths of the parts of a hierarchy."""

from __future__ import annotations

import pytest

from skillweave._internal.paths import (
    below,
    decides,
    is_below,
    join,
    level_of,
    levels_to,
    name_of,
    names_in,
    relative,
)

PATHS = ["skill", "inner/skill", "a/b/c", "inner/selector"]


@pytest.mark.parametrize("path", PATHS)
def test_a_path_is_its_level_and_its_name(path):
    assert join(level_of(path), name_of(path)) == path
    assert join(*names_in(path)) == path
    assert is_below(path, level_of(path))
    assert relative(path, level_of(path)) == name_of(path)


def test_the_outermost_level_is_empty():
    assert level_of("skill") == ""
    assert names_in("") == ()
    assert join("", "skill") == "skill"
    assert not is_below("", "")
    assert relative("inner/skill", "") == "inner/skill"


def test_levels_lead_from_the_outermost_to_the_path():
    assert levels_to("") == [""]
    assert levels_to("a/b/c") == ["", "a", "a/b", "a/b/c"]


def test_below_a_level_stands_what_has_its_whole_name():
    by_path = {"inner": 0, "inner/a": 1, "inner/b/c": 2, "inner2/a": 3, "a": 4}
    assert below(by_path, "inner") == {"a": 1, "b/c": 2}
    assert below(by_path, "") == by_path


@pytest.mark.parametrize(
    ("path", "it_does"),
    [("selector", True), ("a/b/skill_critic", True), ("selector/a", False), ("myselector", False)],
)
def test_selectors_and_critics_decide(path, it_does):
    assert decides(path) is it_does
