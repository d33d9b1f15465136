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


def test_levels_lead_from_the_outermost_which_is_empty_to_what_has_their_whole_name():
    assert (level_of("skill"), names_in(""), join("", "skill")) == ("", (), "skill")
    assert not is_below("", "")
    assert relative("inner/skill", "") == "inner/skill"
    assert levels_to("") == [""]
    assert levels_to("a/b/c") == ["", "a", "a/b", "a/b/c"]
    by_path = {"inner": 0, "inner/a": 1, "inner/b/c": 2, "inner2/a": 3, "a": 4}
    assert below(by_path, "inner") == {"a": 1, "b/c": 2}
    assert below(by_path, "") == by_path
    deciding = ["selector", "a/b/skill_critic", "selector/a", "myselector"]
    assert [decides(path) for path in deciding] == [True, True, False, False]
