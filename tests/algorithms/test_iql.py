"""IQL and CQL on a toy whose values are known: what the data do not show must not be believed."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

import skillweave as sw
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Sample

STATES, ACTIONS = 2, 3
REWARD = np.array([[0.0, 1.0, 9.0], [2.0, 0.0, 9.0]], np.float32)
"""Of each action in each state; the last action is never in the data."""


def sample(rng: np.random.Generator, size: int = 64) -> Sample:
    """Return single steps of a bandit with two states, and actions 0 and 1."""
    state = rng.integers(STATES, size=(1, size))
    action = rng.integers(2, size=(1, size))
    return Sample(
        obs=torch.from_numpy(state), action=torch.from_numpy(action),
        reward=torch.from_numpy(REWARD[state, action]), discount=torch.zeros(1, size),
        next_obs=torch.from_numpy(state), mask=None, next_mask=None, weight=None,
        index=np.zeros((1, size), np.int64),
    )  # fmt: skip


SETTINGS = {
    "learning_rate": 1e-2, "learning_rate_schedule": "constant", "tau": 0.1,
    "normalize_rewards": False, "network": sw.Network((32,)),
}  # fmt: skip


def learnt(config):
    spaces = gym.spaces.Discrete(STATES), gym.spaces.Discrete(ACTIONS)
    algorithm = make_algorithm(config, *spaces)
    state = algorithm.init([Seeds(0)])
    rng, generators = np.random.default_rng(0), [Seeds(1).torch()]
    for _ in range(2_000):
        state, _ = algorithm.update(state, sample(rng), generators)
    return algorithm, state


def test_iql_chooses_the_better_of_the_actions_that_it_has_seen():
    algorithm, state = learnt(sw.IQL(**SETTINGS, expectile=0.9, beta=3.0))
    obs = torch.arange(STATES)[None]
    action, _, _ = algorithm.act(algorithm.learning_params(state), obs, None, None)
    assert action.tolist() == [[1, 0]]
    # The 0.9-expectile of 0 and 1, and that of 0 and 2.
    assert algorithm.value(state, obs)[0].tolist() == pytest.approx([0.9, 1.8], abs=0.05)


def test_iql_without_beta_clones():
    algorithm, state = learnt(sw.IQL(**SETTINGS, beta=0.0))
    _, logits, _ = algorithm.act(
        algorithm.learning_params(state), torch.arange(STATES)[None], None, None
    )
    chances = logits[0].softmax(-1)
    assert chances[:, :2].numpy() == pytest.approx(0.5, abs=0.06)


def test_iql_weighs_actions_by_their_advantage_by_hand():
    algorithm, state = learnt(sw.IQL(**SETTINGS, expectile=0.5, beta=2.0))
    _, logits, _ = algorithm.act(
        algorithm.learning_params(state), torch.arange(STATES)[None], None, None
    )
    # Advantages are ±0.5, and ±1: π(better)/π(worse) = exp(2·(0.5 + 0.5)), exp(2·2).
    odds = logits[0, :, :2].diff(dim=-1)[:, 0]
    assert odds.tolist() == pytest.approx([2.0, -4.0], abs=0.3)


def test_cql_gives_an_unseen_action_less_than_those_that_it_has_seen():
    algorithm, state = learnt(sw.CQL(**SETTINGS, cql_alpha=0.5))
    obs = torch.arange(STATES)[None]
    action, q, _ = algorithm.act(algorithm.learning_params(state), obs, None, None)
    assert action.tolist() == [[1, 0]]
    assert (q[0, :, 2] < q[0, :, :2].min(-1).values).all()
    # Where the gradient is 0: each Q(s, a) is off by α·(softmax(Q)(a) − β(a))/β(a), β = 1/2.
    share = q[0].softmax(-1)[:, :2].numpy()
    expected = REWARD[:, :2] - 0.5 * (share - 0.5) / 0.5
    assert q[0, :, :2].numpy() == pytest.approx(expected, abs=0.12)
