"""Names of skills name files: what a file system cannot tell apart, or take, is refused at once."""

from __future__ import annotations

import pytest
from small_runs import ON, Left

from skillweave import Hierarchy, Skill, SkillweaveError


def named(name) -> Skill:
    return type("Named", (Left,), {"name": name})()


REFUSED = {
    "which names a stage": ["Selector", "TOGETHER", "Agent", "Skill_Critic"],
    "use letters, digits, '_' and '-', at most 64": [
        "a/b", "..", "left.", "left ", "a\\b", "x" * 65, "größe", "a\0b", "-left", "left\n",
    ],
    "differ in case alone": [("Left", "left"), ("a1", "A1"), ("go-Left", "GO-left")],
}  # fmt: skip


@pytest.mark.parametrize(("says", "name"), [(k, name) for k, v in REFUSED.items() for name in v])
def test_what_names_no_file_everywhere(says, name):
    names = name if isinstance(name, tuple) else (name,)
    with pytest.raises(SkillweaveError, match=says) as caught:
        Hierarchy("CartPole-v1", [named(each) for each in names])
    assert len(names) == 1 or all(repr(each) in str(caught.value) for each in names)


def test_names_that_are_too_long_together(tmp_path):
    skill = named("x" * 64)
    for letter in "abcd":
        skill = Hierarchy("CartPole-v1", [skill, named("y" * 64)], algorithm=ON, selector=ON)
        skill.name = letter * 64
        skill = skill.as_skill(call_steps=4)
    tree = Hierarchy("CartPole-v1", [skill], algorithm=ON, selector=ON, steps=300)
    with pytest.raises(SkillweaveError, match="give skills on the way to it shorter names"):
        tree.train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()
