"""PPO on rows that a reflex, or an earlier policy, acted in; and an anchor with a memory."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from toys import rollout_of

from skillweave import PPO, Network
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import RNN
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Reference, Rollout
from skillweave.algorithms.ppo import Terms

SEEN = gym.spaces.Box(-1, 1, (3,), np.float32)
LINE, FORCE = gym.spaces.Discrete(4), gym.spaces.Box(-1, 1, (2,), np.float32)
PLAIN, GRU = Network((8,)), Network((8,), rnn=RNN("gru", 4))
LEAD = T, B = 8, 4


def made(space=LINE, network=PLAIN, **more):
    config = PPO(network=network, batch_size=16, learning_rate=1e-2, **more)
    algorithm = make_algorithm(config, SEEN, space)
    return algorithm, algorithm.init([Seeds(0)])


def learnt(algorithm, rollout):
    """The parameters after an update, by name, and its metrics."""
    state = algorithm.init([Seeds(0)])
    state, report = algorithm.update(state, rollout, [torch.Generator().manual_seed(1)])
    return algorithm.layout.views(state.params), report.metrics


CASES = [(LINE, PLAIN), (FORCE, PLAIN), (LINE, GRU)]


@pytest.mark.parametrize(("space", "network"), CASES)
def test_what_a_reflex_did_trains_the_critic_and_not_the_policy(space, network):
    algorithm, state = made(space, network)
    rollout = rollout_of(algorithm, state, 0, T, B)
    overridden = torch.rand(1, T, B, generator=torch.Generator().manual_seed(5)) < 0.4
    rollout.overridden = overridden
    other = replace(rollout, action=rollout.action.clone())
    other.action[overridden] = other.action[overridden].flip(0) * 0
    assert not torch.equal(other.action, rollout.action)
    one, told = learnt(algorithm, rollout)
    two, _ = learnt(algorithm, other)
    for name in one:
        assert torch.equal(one[name], two[name]), "which action it was makes no difference"
    assert told["samples"] == T * B
    paid = replace(rollout, reward=rollout.reward + 5.0 * overridden)
    three, _ = learnt(algorithm, paid)
    critic = [k for k in one if k.startswith("critic")]
    assert any(not torch.equal(one[k], three[k]) for k in critic)


def test_a_policy_whose_actions_are_all_overridden_stays_as_it_is():
    algorithm, state = made()
    rollout = rollout_of(algorithm, state, 0, T, B)
    rollout.overridden = torch.ones(1, T, B, dtype=torch.bool)
    before = algorithm.layout.views(algorithm.init([Seeds(0)]).params)
    after, told = learnt(algorithm, rollout)
    for name, value in before.items():
        assert torch.equal(value, after[name]) == name.startswith("actor"), name
    assert all(bool(v.isfinite().all()) for v in told.values())


def test_each_rollout_that_was_held_counts_by_the_deviation_it_was_acted_with():
    algorithm, first = made(FORCE, normalize_obs=False)
    second = algorithm.init([Seeds(0)])
    algorithm.layout.views(second.params)["actor.log_std"].sub_(0.7)
    one, two = rollout_of(algorithm, first, 0, T, B), rollout_of(algorithm, second, 1, T, B)
    both = {
        k: torch.cat([getattr(one, k), getattr(two, k)], 2)
        for k in ("obs", "action", "reward", "discount", "next_obs", "last", "dist_params")
    }
    each = torch.cat([x.log_std.expand(1, 1, B, 2) for x in (one, two)], 2)
    whole = Rollout(**both, log_std=each)
    samples, _ = algorithm.samples(second, whole, Terms.of(algorithm.config, second, whole))
    importance = samples.importance.view(1, T, 2 * B)
    torch.testing.assert_close(importance[..., B:], torch.ones(1, T, B))
    std = [x.log_std[0, 0, 0].exp() for x in (one, two)]
    log_prob = [
        torch.distributions.Normal(one.dist_params, s).log_prob(one.action).sum(-1) for s in std
    ]
    torch.testing.assert_close(importance[..., :B], (log_prob[1] - log_prob[0]).exp())


@pytest.mark.parametrize(("space", "network"), CASES)
def test_an_anchor_is_no_distance_from_the_policy_that_it_is_a_copy_of(space, network):
    algorithm, state = made(space, network, update_epochs=1)
    rollout = rollout_of(algorithm, state, 0, T, B)
    rollout.reference = Reference(algorithm.acting_params(state), torch.ones(1))
    samples, _ = algorithm.samples(state, rollout, Terms.of(algorithm.config, state, rollout))
    assert samples.reference.shape[-1] == algorithm.head.width
    torch.testing.assert_close(samples.reference.reshape(1, T, B, -1), rollout.dist_params)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(("space", "network"), CASES)
def test_an_anchor_keeps_a_policy_near(space, network):
    algorithm, _ = made(space, network, update_epochs=8)
    moved = {}
    for coef in (0.0, 100.0):
        state = algorithm.init([Seeds(0)])
        near = Reference(algorithm.acting_params(state), torch.tensor([coef]))
        for i in range(3):
            rollout = rollout_of(algorithm, state, i, T, B, reference=near)
            state, report = algorithm.update(state, rollout, [torch.Generator().manual_seed(1)])
        moved[coef] = report.metrics["reference_kl"].item()
    assert moved[100.0] < 0.1 * moved[0.0]
