"""What the algorithms of a replay buffer share, and their settings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.actor_critic import Critics
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.config import (
    DQN,
    PPO,
    SAC,
    TD3,
    SelfImitationPPO,
    config_from_json,
    config_to_json,
)
from skillweave.algorithms.parameters import LARGEST
from skillweave.errors import DeclarationError, RunError
from skillweave.networks.config import CNN, RNN, Network
from skillweave.spaces import obs_codec

NAN = float("nan")
TOGETHER = [
    *((kind, "buffer_size", 15, r"at least 16 \(num_envs \* \(n_step \+ 1\)\)") for kind in (DQN,)),
    (TD3, "buffer_size", 31, r"at least 32 \(num_envs \* \(n_step \+ 1\)\)"),
    *((kind, "network", Network(rnn=RNN()), "without rnn: only PPO supports recurrent networks")
      for kind in (DQN, SAC)),
    (SelfImitationPPO, "network", Network(rnn=RNN()), "without rnn: kept rows have no .* state"),
    *((kind, "critic", Network(rnn=RNN()), "without rnn") for kind in (TD3, PPO)),
    *((kind, "critic", Network(planes="last"), "without planes: Network.planes of network counts "
       "for both") for kind in (SAC, PPO)),
    (DQN, "v_max", -10.0, r"more than v_min \(-10\.0\)"),
    (DQN, "v_max", None, r"a finite number where v_min is one \(-10\.0\)"),
    (DQN, "v_min", None, r"a finite number where v_max is one \(0\.0\)"),
]  # fmt: skip
"""Settings that do not fit others; tests/test_settings.py tries each one alone."""


@pytest.mark.parametrize(("kind", "name", "value", "asked"), TOGETHER)
def test_settings_that_do_not_fit_each_other_are_named(kind, name, value, asked):
    beside = {"v_max": {"v_min": -10.0}, "v_min": {"v_max": 0.0}}.get(name, {})
    with pytest.raises(DeclarationError, match=rf"{kind.__name__}\.{name} is .*must be {asked}$"):
        kind(**{**beside, name: value})


@pytest.mark.parametrize(
    "config",
    [
        DQN.rainbow(buffer_size=100, learning_starts=7),
        TD3.ddpg(critic=Network((8,), "relu", True)),
        SAC(target_entropy=-3.0, network=Network(cnn=CNN.impala((4,)))),
        PPO(network=Network(rnn=RNN("gru", 5), encoder="mine", cnn=CNN.small())),
        SelfImitationPPO(imitation_rows=5, target_kl=0.1, critic=Network((8,), "relu", True)),
    ],
    ids=lambda c: type(c).__name__,
)
def test_settings_survive_json(config):
    data = config_to_json(config)
    assert data["algorithm"] == type(config).__name__
    assert config_from_json(data) == config


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"algorithm": "SARSA"}, "'SARSA'.*PPO"),
        ({"momentum": 1}, "SAC has no field momentum"),
        ({"network": {"cnn": {"depth": 3}}}, r"SAC\.network\.cnn has no field depth"),
        ({"network": {"rnn": {"kind": "elman"}}}, r"rnn\.kind is 'elman'; .* lstm, gru"),
        ({"network": {"rnn": {"kind": "gru"}}}, r"SAC\.network .*only PPO supports recurrent"),
    ],
)
def test_unknown_settings_in_json_are_named(change, says):
    with pytest.raises(RunError, match=says):
        config_from_json({**config_to_json(SAC()), **change})


def test_random_forces_span_the_range_and_every_member_has_its_own():
    algorithm = make_algorithm(SAC(), Discrete(2), Box(-3.0, 5.0, (2,)))
    generators = [Seeds(m).torch() for m in range(2)]
    drawn = algorithm.random_actions(generators, 5000, None)
    assert drawn.shape == (2, 5000, 2)
    for each in drawn.flatten(0, 1).T, drawn[0].T[0]:
        assert each.min() < -0.99
        assert each.max() > 0.99
        assert each.mean().item() == pytest.approx(0.0, abs=0.04)
    assert not torch.equal(drawn[0], drawn[1])
    alone = algorithm.random_actions([Seeds(1).torch()], 5000, None)
    assert torch.equal(alone[0], drawn[1])


def test_critics_of_a_member_differ_and_do_not_depend_on_its_neighbours():
    obs = obs_codec(Box(-1, 1, (3,)))
    critics = Critics(obs, Network((8,)), 1, extra=2)
    flat = critics.init([Seeds(m).torch() for m in range(3)])
    assert flat.shape[:2] == (3, 2)
    assert not torch.equal(flat[0, 0], flat[0, 1])
    x, action = torch.randn(3, 5, 3), torch.randn(3, 5, 2)
    whole = critics(critics.views(flat), {"vector": x}, action)
    assert whole.shape == (3, 2, 5, 1)
    for m in range(3):
        alone = critics.init([Seeds(m).torch()])
        assert torch.equal(alone[0], flat[m])
        for k in range(2):
            one = critics(critics.views(flat[m : m + 1, k : k + 1]),
                          {"vector": x[m : m + 1]}, action[m : m + 1])  # fmt: skip
            torch.testing.assert_close(one[0, 0], whole[m, k])
    first = critics(critics.views(flat[:, :1]), {"vector": x}, action)
    torch.testing.assert_close(first[:, 0], whole[:, 0])


def stepped(config, scale):
    """The state after a step of the critics, its critics before, and the gradient's norm."""
    algorithm = make_algorithm(config, Box(-1, 1, (3,)), Box(-1, 1, (1,)))
    state = algorithm.init([Seeds(0)])
    leaves = algorithm.critics.leaves(state.critic)
    x, action = {"vector": torch.ones(1, 5, 3)}, torch.ones(1, 5, 1)
    loss = scale * algorithm.critics(leaves, x, action).square().mean((1, 2, 3))
    before = state.critic.clone()
    norm = algorithm.critics.step_(state, loss, leaves, torch.tensor([0.1]), 1e-8)
    return state, before, norm.item()


def test_a_step_of_the_critics_clips_both_together():
    config = replace(SAC(), network=Network((4,)), max_grad_norm=1e-3)
    state, before, norm = stepped(config, 100.0)
    assert norm > 1.0
    assert state.critic_mu.norm().item() == pytest.approx(0.1 * 1e-3, rel=1e-3)
    assert not torch.equal(state.critic[:, 0], before[:, 0])
    assert not torch.equal(state.critic[:, 1], before[:, 1])


@pytest.mark.parametrize("kind", [SAC, TD3])
def test_gradients_are_not_clipped_unless_asked_for(kind):
    config = kind(network=Network((4,)))
    assert (config.max_grad_norm, config.normalize_obs) == (None, True)
    assert config_from_json(config_to_json(config)) == config
    old = config_to_json(config) | {"max_grad_norm": 10.0, "normalize_obs": False}
    assert config_from_json(old) == replace(config, max_grad_norm=10.0, normalize_obs=False)
    state, _, norm = stepped(config, 1e6)
    assert state.max_grad_norm.tolist() == [LARGEST]
    assert norm > 1e3
    assert state.critic_mu.norm().item() == pytest.approx(0.1 * norm, rel=1e-4)


def test_the_slow_networks_turn_comes_beyond_what_a_float_can_count():
    config = TD3(network=Network((4,)), policy_delay=2, target_noise=0.0)
    algorithm = make_algorithm(config, Box(-1, 1, (3,)), Box(-1, 1, (1,)))
    state = algorithm.init([Seeds(0)])
    state.updates += 1 << 24
    obs, one = torch.zeros(1, 4, 3), torch.ones(1, 4)
    sample = Sample(obs, one[..., None], one, one, obs, None, None, None, np.zeros((1, 4), int))
    moved = []
    for _ in range(4):
        before = state.params.clone()
        algorithm.update(state, sample, [])
        moved.append(not torch.equal(state.params, before))
    assert moved == [False, True, False, True]
    assert state.updates.tolist() == [(1 << 24) + 4]


def sample_of(reward, discount, **fields) -> Sample:
    """One member's transitions, all from and to the origin."""
    rows = torch.tensor([reward])
    zeros = torch.zeros(1, rows.shape[1], 3)
    action = torch.full((1, rows.shape[1], 1), 0.1)
    index = np.zeros(rows.shape, int)
    return Sample(
        zeros, action, rows, torch.tensor([discount]), zeros, None, None, None, index, **fields
    )


def learner_of_ends(kind, **settings):
    config = kind(num_envs=2, gamma=0.9, normalize_obs=False, network=Network((8,)), **settings)
    algorithm = make_algorithm(config, Box(-1, 1, (3,)), Box(-1, 1, (1,)))
    return algorithm, algorithm.init([Seeds(0)])


@pytest.mark.parametrize("kind", [SAC, TD3])
def test_where_ends_alone_pay_critics_learn_the_cost_of_the_way(kind):
    """At an end that pays 2, V - 2 in units of 0.2: each step costs 1, the end pays nothing."""
    algorithm, state = learner_of_ends(kind)
    paid = sample_of([0.0, 2.0, 0.0, 2.0 * 0.9], [0.9, 0.0, 0.81, 0.0])
    algorithm.update(state, paid, [Seeds(0).torch()])
    assert (state.end_pay.item(), state.paid_before.item()) == (2.0, 0.0)
    # The last one: two steps to an end, of which the first cost 1.
    by_hand = torch.tensor([[-1.0, 0.0, -1.9, -1.0]])
    torch.testing.assert_close(algorithm.rewards(state, paid), by_hand)
    # A value of -3 steps that each cost 1, in the user's units: 2 * 0.9**3 = 1.458.
    cost = torch.tensor([[-(1 + 0.9 + 0.81)]])
    torch.testing.assert_close(algorithm.in_rewards(state, cost), torch.tensor([[1.458]]))


@pytest.mark.parametrize("kind", [SAC, TD3])
@pytest.mark.parametrize(("reward", "discount"), [([0.5, 4.0], [0.9, 0.0]), ([0.1], [0.9])])
def test_values_stay_where_other_rewards_change_the_units(kind, reward, discount):
    algorithm, state = learner_of_ends(kind)
    obs = torch.rand(1, 5, 3)
    algorithm.update(state, sample_of([0.0, 2.0], [0.9, 0.0]), [Seeds(0).torch()])
    state.critic += 0.1 * torch.randn(state.critic.shape, generator=Seeds(1).torch())
    inputs = {"vector": obs}
    action = torch.zeros(1, 5, 1)

    def value():
        return algorithm.in_rewards(state, algorithm.smallest(state.critic, inputs, action))

    before = value()
    assert before.std() > 1e-3
    algorithm._see_rewards(state, sample_of(reward, discount))
    assert state.paid_before.item() == 1.0
    torch.testing.assert_close(value(), before)
    torch.testing.assert_close(
        algorithm.rewards(state, sample_of(reward, discount)), torch.tensor([reward])
    )


@pytest.mark.parametrize("normalize", [False, True])
def test_other_rewards_are_learnt_as_they_are(normalize):
    algorithm, state = learner_of_ends(SAC, normalize_rewards=normalize)
    state.return_var, state.return_count = torch.full((1, 1), 4.0), torch.full((1,), 9.0)
    costs = sample_of([-1.0, 0.0, 3.0], [0.9, 0.9, 0.0])
    algorithm.update(state, costs, [Seeds(0).torch()])
    scale = 2.0 if normalize else 1.0
    torch.testing.assert_close(algorithm.rewards(state, costs) * scale, costs.reward)
