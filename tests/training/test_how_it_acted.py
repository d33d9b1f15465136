"""What is told of each who learns together with others: how much it acted, and its reward."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import Together
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Batch
from skillweave.algorithms.config import SkillCritic
from skillweave.training.joint import JointLearner, how_it_acted
from skillweave.training.learner import RolloutLearner, Stack
from skillweave.types import Array


def rows(valid: Array | None = None, steps: Array | None = None) -> Batch:
    """Three rows of two columns, with the rewards 0 to 5."""
    shape, never = (3, 2), np.zeros((3, 2), bool)
    obs = np.zeros((*shape, 1), np.float32)
    reward = np.arange(6, dtype=np.float32).reshape(shape)
    steps = np.ones(shape, np.int64) if steps is None else steps
    ends = {"terminated": never, "truncated": never}
    rows = {"obs": obs, "action": np.zeros(shape), "reward": reward, "steps": steps}
    return Batch(**rows, **ends, next_obs=obs, valid=valid)


def told(name: str, experience: Batch) -> dict[str, float]:
    return {k: float(v) for k, v in how_it_acted(name, experience).items()}


def test_what_is_told_of_skills_selectors_and_critics():
    valid, never = np.array([[True, False], [False, True], [False, False]]), np.zeros((3, 2), bool)
    assert told("inner/left", rows(valid)) == {"usage": np.float32(2 / 6), "reward": 1.5}
    assert told("left", rows(never)) == {"usage": 0.0}
    steps = np.array([[1, 5], [9, 9], [9, 9]])
    first = np.array([[True, True], [False, False], [False, False]])
    assert told("selector", rows(first, steps)) == {"call_length": 3.0}
    assert told("inner/selector", rows(None, steps)) == {"call_length": 7.0}
    assert told("selector", rows(never, steps)) == {}
    assert told("skill_critic", rows()) == {}


@pytest.mark.parametrize(("least", "deviation"), [(0.0, 1.0), (4.0, 0.5)])
def test_a_task_that_says_little_moves_skills_little(least, deviation):
    """The critic gives advantages in deviations of the return, 4 here; their own is 0.5."""
    config = SkillCritic(num_envs=2, n_steps=3, batch_size=6, min_advantage_std=least)
    seen, skills = gym.spaces.Box(-9, 9, (1,), np.float32), gym.spaces.Discrete(2)
    algorithm = make_algorithm(config, seen, skills)
    state = algorithm.init([Seeds(0)])
    state.return_var = torch.full_like(state.return_var, 16.0)
    given = torch.tensor([[[0.5, -0.5]] * 3])
    algorithm.advantage = lambda *_: given
    learner = RolloutLearner(Stack(algorithm, state), Seeds(0))
    joint = JointLearner({"skill_critic": learner}, "", Together(task_weight=0.0))
    found = joint._task_advantage(rows())
    assert found.std() == pytest.approx(deviation, rel=0.01)
