"""Names of skills name files: what a file system cannot tell apart, or take, is refused at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from skillweave import Hierarchy, Skill, SkillweaveError
from tests.small_runs import ON, Left


def named(name: Any) -> Skill:
    return type("Named", (Left,), {"name": name})()


@pytest.mark.parametrize("name", ["Selector", "TOGETHER", "Agent", "Skill_Critic"])
def test_names_of_stages_in_any_case(name):
    with pytest.raises(SkillweaveError, match="which names a stage"):
        Hierarchy("CartPole-v1", [named(name)])


@pytest.mark.parametrize("name", ["con", "NUL", "aux", "Com1", "lpt9"])
def test_devices(name):
    with pytest.raises(SkillweaveError, match="is a device on Windows"):
        Hierarchy("CartPole-v1", [named(name)])


@pytest.mark.parametrize(
    "name", ["a/b", "..", "left.", "left ", "a\\b", "x" * 65, "größe", "a\0b", "-left", "left\n"]
)
def test_what_names_no_file_everywhere(name):
    with pytest.raises(SkillweaveError, match="use letters, digits, '_' and '-', at most 64"):
        Hierarchy("CartPole-v1", [named(name)])


@pytest.mark.parametrize("pair", [("Left", "left"), ("a1", "A1"), ("go-Left", "GO-left")])
def test_names_that_differ_in_case_alone(pair):
    with pytest.raises(SkillweaveError, match="differ in case alone") as caught:
        Hierarchy("CartPole-v1", [named(name) for name in pair])
    assert all(repr(name) in str(caught.value) for name in pair)


def test_names_that_are_too_long_together(tmp_path: Path):
    skill: Any = named("x" * 64)
    for letter in "abcd":
        skill = Hierarchy("CartPole-v1", [skill, named("y" * 64)], algorithm=ON, selector=ON)
        skill.name = letter * 64
        skill = skill.as_skill(call_steps=4)
    tree = Hierarchy("CartPole-v1", [skill], algorithm=ON, selector=ON, steps=300)
    with pytest.raises(SkillweaveError, match="give skills on the way to it shorter names"):
        tree.train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()
