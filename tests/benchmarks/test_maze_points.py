"""The large maze with one skill with a goal: the points that it rolls to, and its budget."""

import numpy as np
import pytest
import torch

from benchmarks import maze_points
from benchmarks.pay.mazes import suite
from skillweave import Step

SKILL = maze_points.GoTo()


def test_it_has_as_many_steps_as_the_recipe():
    pytest.importorskip("gymnasium_robotics")
    assert maze_points.declare().total_steps == suite().steps()[0]


def test_points_are_the_middles_of_cells():
    obs = np.zeros((2, 6), np.float32)
    obs[:, :2] = [[-5.9, -4.4], [1.2, 0.0]]
    assert maze_points.cell_of(obs).tolist() == [[0, 0], [7, 4]]
    assert maze_points.middle(maze_points.cell_of(obs)).tolist() == [[-5.5, -4.0], [1.5, 0.0]]


def test_points_to_practise_are_in_range_and_in_the_maze():
    obs = np.zeros((400, 6), np.float32)
    obs[200:, :2] = [-5.5, 4.0]  # the north-western cell
    goals = SKILL.goals(obs, np.random.default_rng(0))
    middle, corner = goals[:200], goals[200:]
    assert len(np.unique(middle, axis=0)) == 25
    assert (np.abs(middle - [6, 4]) <= maze_points.RANGE).all()
    assert len(np.unique(corner, axis=0)) == 9
    assert all(SKILL.goal_space.contains(goal) for goal in goals)
    chosen = np.array([[11, 4], [0, 8], [7, 3]])  # from cell (6, 4): moved into range
    assert SKILL.clip_goal(obs[:3], chosen).tolist() == [[8, 4], [4, 6], [7, 3]]


def test_networks_see_the_speed_and_the_way_to_the_point():
    obs = torch.zeros(1, 1, 27)
    obs[0, 0, :4] = torch.tensor([1.0, -1.0, 3.0, 4.0])
    obs[0, 0, 6 + 7] = obs[0, 0, 6 + 12 + 4] = 1.0  # cell (7, 4), its middle is (1.5, 0)
    seen = maze_points.Motion(None)(None, {"vector": obs})
    assert seen.tolist() == [[[3.0, 4.0, 0.5, 1.0]]]


def test_a_call_ends_at_its_point_or_at_a_wall():
    before, after = np.zeros((2, 4, 6), np.float32)
    before[:, 0] = after[:, 0] = [0, 0, 0, 1.3]
    after[:, 2] = before[:, 2] = [1.0, 0.0, 0.0, 1.0]  # fast, stuck, stuck but just started, there
    no, goal = np.zeros(4, bool), np.tile([7, 4], (4, 1))
    elapsed = np.array([9, 9, 1, 9])
    step = Step(before, np.zeros((4, 2)), after, np.zeros(4), no, no, no, elapsed, {}, goal)
    assert SKILL.termination(step).tolist() == [False, True, False, True]
    assert SKILL.success(step).tolist() == [False, False, False, True]
