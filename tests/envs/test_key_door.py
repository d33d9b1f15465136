"""``KeyDoor``: its rules, its pictures, and that it is found by its id."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from skillweave import EnvSpec
from skillweave.toys import KeyDoor

EXIT, DOOR = np.array([1.0, 0.0]), np.array([0.2, 0.0])
ROOT = Path(__file__).parents[2]


def towards(obs: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The action that leads straight to ``point``."""
    way = point - obs[:2]
    return (way / max(float(np.abs(way).max()), 1e-6)).astype(np.float32)


def by_hand(obs: np.ndarray) -> np.ndarray:
    """The action of a policy that solves it."""
    if obs[5]:
        return towards(obs, EXIT if abs(obs[1]) < 0.1 or obs[0] > 0.3 else DOOR)
    return towards(obs, DOOR if obs[4] else obs[2:4])


def test_it_is_an_environment_as_gymnasium_asks() -> None:
    check_env(gym.make("skillweave/KeyDoor-v0", render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("seed", range(10))
def test_key_then_door_then_exit_pays_one(seed: int) -> None:
    env = KeyDoor()
    obs, _ = env.reset(seed=seed)
    total, seen = 0.0, []
    for _ in range(env.max_steps):
        obs, reward, terminated, truncated, info = env.step(by_hand(obs))
        assert env.observation_space.contains(obs)
        total += reward
        seen.append((obs[4], obs[5]))
        if terminated:
            break
    assert (total, terminated, truncated, info) == (1.0, True, False, {"success": True})
    assert sorted(seen) == seen  # first the key, then the door; neither is ever lost


def test_the_door_is_shut_to_who_has_no_key_and_walls_stop_the_motion_across_them_alone() -> None:
    env = KeyDoor()
    for seed in range(10):
        obs, _ = env.reset(seed=seed)
        env._key = (-1.0, 1.0)
        env._place = (0.0, 0.0)
        for _ in range(40):
            obs, *_ = env.step(np.array([1.0, 0.0], np.float32))
        assert obs[0] < 0.2
        assert obs[5] == 0.0
    env.reset(seed=0)
    env._key, env._place, env._is_open = (-1.0, 1.0), (0.1, -0.8), True
    obs, *_ = env.step(np.array([1.0, 1.0], np.float32))
    assert obs[:2] == pytest.approx((0.1, -0.75))


def test_episodes_start_in_the_left_room_and_are_truncated_at_their_limit() -> None:
    env = KeyDoor(max_steps=3)
    starts = np.array([env.reset(seed=seed)[0] for seed in range(200)])
    assert starts[:, [0, 2]].max() <= 0.0
    assert starts[:, [0, 1]].min() >= -1.0
    assert len(np.unique(starts[:, 1])) == 200
    assert (starts[:, 4:] == 0).all()
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_a_picture_shows_the_key_until_it_is_taken_and_the_door_as_it_stands() -> None:
    env = KeyDoor(render_mode="rgb_array")
    env.reset(seed=0)
    env._key, env._place = (-0.5, 0.5), (-0.5, -0.5)
    before = env.render()
    assert before is not None
    assert before.shape == (320, 320, 3)
    assert before.dtype == np.uint8
    env._has_key, env._is_open = True, True
    after = env.render()
    assert after is not None

    def patch(frame: np.ndarray, x: float, y: float) -> np.ndarray:
        column, row = (int((v + 1.15) / 2.3 * 320) for v in (x, -y))
        return frame[row - 8 : row + 8, column - 8 : column + 8].astype(int)

    for x, y in ((-0.5, 0.5), (0.2, 0.0)):
        assert np.abs(patch(before, x, y) - patch(after, x, y)).max() > 60
    floor = patch(after, -0.8, 0.9)
    assert (floor == floor[0, 0]).all()


def test_pictures_leave_a_trail_and_none_are_made_unasked() -> None:
    env = KeyDoor(render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    for _ in range(8):
        env.step(np.array([-0.5, 0.0], np.float32))
    last = env.render()
    env.reset(seed=1)
    again = env.render()
    np.testing.assert_array_equal(first, again)
    assert (first != last).any()
    assert KeyDoor().render() is None


def test_it_is_found_by_its_id_and_needs_no_torch() -> None:
    made = EnvSpec("skillweave/KeyDoor-v0").make()
    assert isinstance(made.unwrapped, KeyDoor)
    code = (
        "import sys, skillweave.toys, gymnasium; gymnasium.make('skillweave/KeyDoor-v0');"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
