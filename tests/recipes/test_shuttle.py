"""Shuttle: the automaton's rewards and legs by hand, over positions that are written down."""

from __future__ import annotations

import sys

import gymnasium as gym
import numpy as np
import pytest

from skillweave import SkillweaveError, Step
from skillweave.recipes import shuttle

COST = -0.25


class Runner(gym.Env):
    """Stands at 0, then where a list says; every action costs the same."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (18,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self, places):
        self.places = places

    def reset(self, *, seed=None, options=None):
        self.left = list(self.places)
        return self._obs(0.0), {}

    def step(self, action):
        x = self.left.pop(0)
        info = {"x_position": x, "reward_ctrl": COST}
        return self._obs(x), 99.0, False, not self.left, info

    def _obs(self, x):
        return np.array([x, *np.zeros(17)])


def run(points, places):
    """Rewards, and the leg after each step."""
    env = shuttle.Patrol(Runner(places), points)
    obs, _ = env.reset()
    assert obs.shape == (21,)
    assert obs[shuttle.LEG].tolist() == [1.0, 0.0, 0.0]
    rewards, legs = [], []
    for _ in places:
        obs, reward, *_ = env.step(np.zeros(6))
        rewards.append(reward)
        legs.append(int(obs[shuttle.LEG].argmax()))
        assert obs[shuttle.LEG].sum() == 1.0
    return rewards, legs


def test_a_round_of_the_papers_task_pays_a_thousand_at_its_end_and_nothing_between():
    places = [1.0, 2.0, 2.1, 5.0, -2.0, -2.1, -3.0, 3.0, -9.0]
    rewards, legs = run((2.0, -2.0), places)
    # The point itself is not beyond it. The step that pays costs no effort, as in the paper.
    assert rewards == [COST, COST, COST, COST, COST, 1000.0, COST, COST, 1000.0]
    assert legs == [0, 0, 1, 1, 1, 0, 0, 1, 0]


def test_where_it_begins_beyond_a_point_of_a_later_leg_that_leg_still_has_to_wait():
    rewards, legs = run((2.0, -2.0), [-3.0, -3.0, 3.0])
    assert rewards == [COST] * 3
    assert legs == [0, 0, 1]


def test_a_patrol_of_three_points_passes_each_in_its_direction():
    rewards, legs = run((2.0, 6.0, -2.0), [3.0, 5.0, 7.0, 1.0, -3.0, 3.0])
    assert rewards == [COST, COST, COST, COST, 1000.0, COST]
    assert legs == [1, 1, 2, 2, 0, 1]


def test_one_step_passes_one_point_at_most():
    assert run((2.0, 6.0, -2.0), [7.0, 7.0])[1] == [1, 2]


@pytest.mark.parametrize("points", [(2.0,), (1.0, 1.0), (1.0, 2.0, 3.0, 4.0), (1.0, 2.0, 2.0)])
def test_points_that_make_no_patrol_are_refused(points):
    with pytest.raises(SkillweaveError, match="a patrol has 2 to 3 points"):
        shuttle.Patrol(Runner([]), points)


def step_of(x, next_x, leg, next_leg, action=0.5):
    def obs(x, leg):
        return np.array([[x, *np.zeros(17), *(np.arange(3) == leg)]], np.float32)

    no, one = np.zeros(1, bool), np.ones(1, np.int64)
    actions = np.full((1, 6), action, np.float32)
    return Step(obs(x, leg), actions, obs(next_x, next_leg), np.zeros(1), no, no, no, one, {})


def test_skills_are_paid_for_speed_less_effort_and_for_the_end_of_a_leg():
    # 0.1 m in 0.05 s are 2 m/s; the effort is 0.1·6·0.5² = 0.15.
    going = step_of(1.0, 1.1, 0, 0)
    assert shuttle.Forward().reward(going) == pytest.approx(2.0 - 0.15, abs=1e-4)
    assert shuttle.Backward().reward(going) == pytest.approx(-2.0 - 0.15, abs=1e-4)
    assert shuttle.Stop().reward(going) == pytest.approx(-2.0 - 0.15, abs=1e-4)
    assert not shuttle.Forward().termination(going)
    there = step_of(1.95, 2.05, 0, 1)
    # The prize is 300, less 40 for each of the 2 m/s.
    assert shuttle.Forward().reward(there) == pytest.approx(1.85 + 220.0, abs=1e-2)
    assert shuttle.Forward().termination(there)


def test_a_missing_extra_is_named_before_anything_is_trained(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SkillweaveError, match=r"skillweave\[mujoco\]"):
        shuttle.declare().train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


def test_the_half_cheetah_itself_has_the_papers_observations_rewards_and_length():
    pytest.importorskip("mujoco")
    env = shuttle.spec().make()
    obs, _ = env.reset(seed=3)
    assert obs.shape == (21,)
    action = np.full(6, 0.5, np.float32)
    for i in range(1, 1001):
        before = obs
        obs, reward, terminated, truncated, info = env.step(action)
        assert obs[shuttle.X] == pytest.approx(info["x_position"], abs=1e-5)
        assert (truncated, terminated) == (i == 1000, False)
        if reward < 500:
            assert reward == pytest.approx(-0.15)  # 0.1·6·0.5²
    speed = (obs[shuttle.X] - before[shuttle.X]) / shuttle.SECONDS
    assert speed == pytest.approx(info["x_velocity"], abs=1e-3)
