"""The large maze with one skill with a goal: the points that it rolls to, and its budget."""

import numpy as np
import pytest

from benchmarks import maze_points
from benchmarks.pay.mazes import suite
from skillweave import Step

SKILL = maze_points.GoTo()


def test_it_has_as_many_steps_as_the_recipe():
    pytest.importorskip("gymnasium_robotics")
    assert maze_points.declare().total_steps == suite().steps()[0]


def test_points_to_practise_are_in_range_and_in_all_directions():
    obs = np.zeros((400, 6), np.float32)
    way = SKILL.goals(obs, np.random.default_rng(0))
    far = np.hypot(*way.T)
    assert maze_points.THERE <= far.min() < 0.4
    assert 1.9 < far.max() <= maze_points.RANGE + 1e-6
    angle = np.arctan2(*way.T)
    assert np.histogram(angle, bins=4, range=(-np.pi, np.pi))[0].min() > 70
    assert all(SKILL.goal_space.contains(point) for point in way)


def test_a_point_out_of_range_is_moved_nearer_in_its_direction():
    obs = np.zeros((4, 6), np.float32)
    obs[:, :2] = [[1, 1], [1, 1], [1, 1], [5.5, 0]]
    chosen = np.array([[1, 4], [-3, 1], [1.5, 1.5], [6, 0]], np.float32)
    got = SKILL.clip_goal(obs, chosen)
    np.testing.assert_allclose(got, [[1, 3], [-1, 1], [1.5, 1.5], [6, 0]])
    assert got.dtype == np.float32
    at_place = SKILL.clip_goal(obs, obs[:, :2])
    np.testing.assert_array_equal(at_place, obs[:, :2])


def test_a_call_ends_at_its_point_or_at_a_wall():
    before, after = np.zeros((2, 4, 6), np.float32)
    before[:, 0] = after[:, 0] = [0, 0, 0, 0.8]
    after[:, 2] = before[:, 2] = [1.0, 0.0, 0.0, 1.0]  # fast, stuck, stuck but just started, there
    no, goal = np.zeros(4, bool), np.tile(np.float32([1, 0]), (4, 1))
    elapsed = np.array([9, 9, 1, 9])
    step = Step(before, np.zeros((4, 2)), after, np.zeros(4), no, no, no, elapsed, {}, goal)
    assert SKILL.termination(step).tolist() == [False, True, False, True]
    assert SKILL.success(step).tolist() == [False, False, False, True]
