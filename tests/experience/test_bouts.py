"""ActionRepeat: an environment takes one random action again and again."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from skillweave import DQN, SAC, TD3, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.experience.acting import Acting, ActionRepeat, Request
from skillweave.training.learner import Stack
from skillweave.training.stack_learner import learner_of

N, LONGEST = 64, 12
OBS = np.zeros((N, 3), np.float32)  # all see the same, so one who does not explore does the same
NET = Network((8,))
SPACE = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
STEER, PUSH = gym.spaces.Box(-1.0, 1.0, (2,), np.float32), gym.spaces.Discrete(5)


def acting_of(config, space):
    algorithm = make_algorithm(config, SPACE, space)
    params = algorithm.acting_params(algorithm.init([Seeds(0)]), 1.0)
    return Acting([(algorithm, 1)], N), params


def next_row(acting, obs, mask):
    """Actions (N, …) in the request's next row."""
    done = acting.some(np.arange(len(obs)), obs, mask, None).action.copy()
    acting.row += 1
    return done


def played(acting, params, at, rows, chance=0.5, mask=None, **how):
    """What is done in rows ``at`` to ``at + rows``, (T, N, …)."""
    action_repeat = ActionRepeat(at, chance, LONGEST, Seeds(1))
    request = Request(rows, (params,), np.ones(1), Seeds(2), action_repeat=action_repeat, **how)
    acting.begin(request)
    return np.stack([next_row(acting, OBS, mask) for _ in range(rows)])


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


def test_where_bouts_are_depends_on_the_collector_and_not_on_how_rows_are_asked_for(steering):
    whole = played(*steering, 0, 3 * LONGEST)
    parts = [played(*steering, at, rows) for at, rows in ((0, 5), (5, 1), (6, 20), (26, 10))]
    np.testing.assert_array_equal(whole, np.concatenate(parts))
    acting, params = steering
    bouts = ActionRepeat(0, 0.5, LONGEST, Seeds(1))
    request = Request(2 * LONGEST, (params,), np.ones(1), Seeds(2), action_repeat=bouts)
    done = []
    for number in (0, 1, 0):
        acting.begin(request.of_collector(number))
        done.append(np.stack([next_row(acting, OBS, None) for _ in range(LONGEST)]))
    np.testing.assert_array_equal(done[0], done[2])
    assert (done[0] != done[1]).any()


def test_a_falling_chance_leaves_out_bouts_and_moves_none(steering):
    many = played(*steering, 0, 4 * LONGEST, chance=0.9)
    few = played(*steering, 0, 4 * LONGEST, chance=0.2)
    own = played(*steering, 0, 1, chance=0.0)[0, 0]
    forced = (few != own).any(-1)
    assert 0 < forced.sum() < (many != own).any(-1).sum()
    np.testing.assert_array_equal(few[forced], many[forced])


def test_nobody_is_in_a_bout_who_acts_greedily_or_at_random(steering):
    own = played(*steering, 0, 1, chance=0.0)[0, 0]
    done = played(*steering, 0, 2 * LONGEST, chance=1.0, greedy=True)
    assert (done == own).all()
    done = played(*steering, 0, 2 * LONGEST, chance=1.0, at_random=True)
    assert (done[1:] != done[:-1]).any(-1).all()


def test_members_of_a_stack_have_the_bouts_that_they_have_alone():
    algorithm = make_algorithm(TD3(network=NET, exploration_noise=0.0), SPACE, STEER)
    members = [algorithm.acting_params(algorithm.init([Seeds(m)]), 1.0) for m in range(3)]
    three = algorithm.acting_params(algorithm.init([Seeds(m) for m in range(3)]), 1.0)
    stacks = Acting([(algorithm, 3)], 3 * N), Acting([(algorithm, 1), (algorithm, 2)], 3 * N)
    two = algorithm.acting_params(algorithm.init([Seeds(m) for m in (1, 2)]), 1.0)
    obs, found = np.zeros((3 * N, 3), np.float32), []
    for acting, params in zip(stacks, ((three,), (members[0], two)), strict=True):
        action_repeat = ActionRepeat(0, 1.0, LONGEST, Seeds(1))
        acting.begin(Request(LONGEST, params, np.ones(3), Seeds(2), action_repeat=action_repeat))
        found.append(np.stack([next_row(acting, obs, None) for _ in range(LONGEST)]))
    np.testing.assert_allclose(*found, atol=1e-6)
    alone = played(Acting([(algorithm, 1)], N), members[0], 0, LONGEST, chance=1.0)
    np.testing.assert_allclose(found[0][:, :N], alone, atol=1e-6)
    assert (found[0][:, :N] != found[0][:, N : 2 * N]).any()


def test_a_learner_counts_rows_from_the_start_of_its_stage_and_asks_for_fewer_bouts_in_the_end():
    config = SAC(num_envs=4, train_freq=3, action_repeat=0.4, action_repeat_steps=7, network=NET)
    algorithm = make_algorithm(config, SPACE, STEER)
    stack = Stack(algorithm, algorithm.init([Seeds(0)]))
    learner = learner_of(stack, 4, Seeds(5))
    asked = [
        learner.request(u, 0, progress).action_repeat
        for u, progress in ((0, 0.0), (1, 0.5), (9, 1))
    ]
    assert [b.at for b in asked] == [0, 3, 27]
    assert [b.chance for b in asked] == pytest.approx([0.4, 0.2, 0.0])
    assert {(b.longest, b.seeds) for b in asked} == {(7, asked[0].seeds)}
    never = make_algorithm(SAC(action_repeat=0.0, network=NET), SPACE, STEER)
    quiet = learner_of(Stack(never, never.init([Seeds(0)])), 8, Seeds(5))
    assert quiet.request(0, 0, 0.0).action_repeat is None


def test_a_forbidden_action_is_not_taken():
    acting, params = acting_of(DQN(network=NET, exploration_final_eps=0.0), PUSH)
    mask = np.ones((N, 5), bool)
    mask[:, 3] = False
    done = played(acting, params, 0, 4 * LONGEST, chance=1.0, mask=mask)
    assert set(done.ravel()) == {0, 1, 2, 4}
