"""What all recipes refuse: tasks that there are not, and environments that are not installed."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym
import pytest

from skillweave.errors import MissingExtra, SkillweaveError
from skillweave.recipes import keys_and_doors, lander_missions, mazes, pick_and_place, shuttle
from skillweave.recipes._cheetah import Patrol
from skillweave.recipes._missions import MissionState


@pytest.mark.parametrize(
    ("declare", "says"),
    [
        (lambda: keys_and_doors.declare("moon"), "no rooms 'moon'; there are: small, unlock-pi"),
        (lambda: lander_missions.declare("moon"), "no mission 'moon'; there are: .*tour"),
        (lambda: mazes.declare("moon"), "no maze 'moon'; there are: large.*diverse"),
        *(
            (lambda legs=legs: MissionState(1, [legs], gusts=False), "has 1 to 3 legs of left")
            for legs in ((), ("left",) * 4, ("left", "up"))
        ),
        *(
            (
                lambda points=points: Patrol(gym.make("CartPole-v1"), points),
                "a patrol has 2 to 3 points",
            )
            for points in ((2.0,), (1.0, 1.0), (1.0, 2.0, 3.0, 4.0), (1.0, 2.0, 2.0))
        ),
    ],
)
def test_a_task_that_there_is_not_is_refused_with_those_that_are(declare: Any, says: str) -> None:
    with pytest.raises(SkillweaveError, match=says):
        declare()


@pytest.mark.parametrize(("recipe", "package"), [(lander_missions, "Box2D"), (shuttle, "mujoco")])
def test_a_task_has_no_threshold_of_the_environments_own_reward(recipe: Any, package: str) -> None:
    pytest.importorskip(package)
    with recipe.declare().spec.make() as env:
        assert env.spec.reward_threshold is None
        assert env.spec.max_episode_steps == 1000


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
