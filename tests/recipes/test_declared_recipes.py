"""What all recipes refuse: tasks that there are not, and environments that are not installed."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from skillweave.errors import DeclarationError, MissingExtra
from skillweave.recipes import keys_and_doors, lander_missions, mazes, pick_and_place, shuttle


@pytest.mark.parametrize(
    ("recipe", "says"),
    [
        (keys_and_doors, "no rooms 'moon'; there are: small, unlock-pickup"),
        (lander_missions, "no mission 'moon'; there are: .*tour"),
        (mazes, "no maze 'moon'; there are: large.*diverse"),
    ],
)
def test_a_task_that_there_is_not_is_refused_with_those_that_are(recipe: Any, says: str) -> None:
    with pytest.raises(DeclarationError, match=says):
        recipe.declare("moon")


@pytest.mark.parametrize(
    ("recipe", "package", "extra"),
    [
        (keys_and_doors, "minigrid", "minigrid"),
        (mazes, "gymnasium_robotics", "robotics"),
        (pick_and_place, "gymnasium_robotics", "robotics"),
        (shuttle, "mujoco", "mujoco"),
    ],
)
def test_a_missing_extra_is_named_before_anything_is_trained(
    recipe: Any, package: str, extra: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtra, match=rf"skillweave\[{extra}\]"):
        recipe.declare().train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()
