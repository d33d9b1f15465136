"""Bouts: an environment takes one random action again and again."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from skillweave import DQN, TD3, Network
from skillweave.algorithms.policy import make_algorithm
from skillweave.collecting.acting import Acting, Bouts, Request
from skillweave.seeding import Seeds

N, LONGEST = 64, 12
OBS = np.zeros((N, 3), np.float32)  # all see the same, so one who does not explore does the same
NET = Network((8,))
SPACE = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
STEER, PUSH = gym.spaces.Box(-1.0, 1.0, (2,), np.float32), gym.spaces.Discrete(5)


def acting_of(config, space):
    algorithm = make_algorithm(config, SPACE, space)
    params = algorithm.acting_params(algorithm.init([Seeds(0)]), 1.0)
    return Acting([(algorithm, 1)], N), params


def played(acting, params, at, rows, chance=0.5, mask=None, **how):
    """What is done in rows ``at`` to ``at + rows``, (T, N, …)."""
    bouts = Bouts(at, chance, LONGEST, Seeds(1))
    request = Request(rows, (params,), np.ones(1), Seeds(2), bouts=bouts, **how)
    acting.begin(request)
    return np.stack([acting.all(OBS, mask, None).action.copy() for _ in range(rows)])


@pytest.fixture
def steering():
    return acting_of(TD3(network=NET, exploration_noise=0.0), STEER)


def test_a_bout_is_one_action_in_a_row_and_no_longer_than_it_may_be(steering):
    done = played(*steering, 0, 20 * LONGEST)
    own = played(*steering, 0, 1, chance=0.0)[0, 0]
    forced = (done != own).any(-1)  # (T, N)
    spans = forced.reshape(20, LONGEST, N)
    actions = done.reshape(20, LONGEST, N, 2)
    lengths = spans.sum(1)
    assert lengths.max() == LONGEST
    assert np.bincount(lengths[lengths > 0], minlength=LONGEST + 1)[1:].min() > 20  # as likely
    assert (lengths > 0).mean() == pytest.approx(0.5, abs=0.05)
    for span, env in np.argwhere(lengths > 0):
        rows = np.flatnonzero(spans[span, :, env])
        assert np.ptp(rows) == len(rows) - 1
        assert (actions[span, rows, env] == actions[span, rows[0], env]).all()
    drawn = actions[spans]
    assert drawn.min() < -0.95
    assert drawn.max() > 0.95


def test_where_bouts_are_does_not_depend_on_how_rows_are_asked_for(steering):
    whole = played(*steering, 0, 3 * LONGEST)
    parts = [played(*steering, at, rows) for at, rows in ((0, 5), (5, 1), (6, 20), (26, 10))]
    np.testing.assert_array_equal(whole, np.concatenate(parts))


def test_a_falling_chance_leaves_out_bouts_and_moves_none(steering):
    many = played(*steering, 0, 4 * LONGEST, chance=0.9)
    few = played(*steering, 0, 4 * LONGEST, chance=0.2)
    own = played(*steering, 0, 1, chance=0.0)[0, 0]
    forced = (few != own).any(-1)
    assert 0 < forced.sum() < (many != own).any(-1).sum()
    np.testing.assert_array_equal(few[forced], many[forced])


def test_nobody_is_in_a_bout_who_acts_greedily(steering):
    acting, params = steering
    own = played(acting, params, 0, 1, chance=0.0)[0, 0]
    # Evaluations are asked for without bouts.
    acting.begin(Request(3, (params,), np.ones(1), Seeds(2), greedy=True))
    np.testing.assert_array_equal(acting.all(OBS, None, None).action, np.tile(own, (N, 1)))


def test_a_forbidden_action_is_not_taken():
    acting, params = acting_of(DQN(network=NET, exploration_final_eps=0.0), PUSH)
    mask = np.ones((N, 5), bool)
    mask[:, 3] = False
    done = played(acting, params, 0, 4 * LONGEST, chance=1.0, mask=mask)
    assert set(done.ravel()) == {0, 1, 2, 4}


def test_collectors_have_bouts_of_their_own(steering):
    acting, params = steering
    request = Request(
        2 * LONGEST, (params,), np.ones(1), Seeds(2), bouts=Bouts(0, 0.5, LONGEST, Seeds(1))
    )
    done = []
    for number in (0, 1, 0):
        acting.begin(request.of_collector(number))
        done.append(np.stack([acting.all(OBS, None, None).action.copy() for _ in range(LONGEST)]))
    np.testing.assert_array_equal(done[0], done[2])
    assert (done[0] != done[1]).any()
