"""What the algorithms of a replay buffer share, and their settings."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from skillweave.algorithms.actor_critic import Critics
from skillweave.algorithms.config import (
    DQN,
    PPO,
    SAC,
    TD3,
    OffPolicy,
    config_from_json,
    config_to_json,
)
from skillweave.algorithms.parameters import LARGEST
from skillweave.algorithms.policy import make_algorithm
from skillweave.errors import SkillweaveError
from skillweave.experience import Sample
from skillweave.networks.config import CNN, RNN, Network
from skillweave.ops.losses import weighted_mean
from skillweave.ops.returns import td_target
from skillweave.seeding import Seeds
from skillweave.spaces import obs_codec

NAN, INF = float("nan"), float("inf")
RANGES: list[tuple[type, str, object, str]] = [
    *((OffPolicy, name, bad, "at least 1") for name in (
        "num_envs", "train_freq", "batch_size", "n_step", "threads") for bad in (0, -3)),
    *((OffPolicy, name, bad, "between 0 and 1") for name in (
        "gamma", "tau", "priority_alpha", "priority_beta") for bad in (-0.1, 1.1, NAN)),
    *((OffPolicy, name, bad, "positive and finite") for name in (
        "learning_rate", "max_grad_norm", "adam_eps", "update_ratio") for bad in (0.0, INF, NAN)),
    (OffPolicy, "device", "tpu", "one of cpu, cuda, auto"),
    (PPO, "device", "tpu", "one of cpu, cuda, auto"),
    *((kind, "compile", bad, "True, False or auto")
      for kind in (OffPolicy, PPO) for bad in (1, "always")),
    (OffPolicy, "buffer_size", 0, "at least 1"),
    *((kind, "buffer_size", 15, r"at least 16 \(num_envs·\(n_step\+1\)\)") for kind in (DQN, SAC)),
    (TD3, "buffer_size", 31, r"at least 32 \(num_envs·\(n_step\+1\)\)"),
    *((OffPolicy, "action_repeat", bad, "between 0 and 1") for bad in (-0.1, 1.1, NAN)),
    (OffPolicy, "action_repeat_steps", 0, "at least 1"),
    (OffPolicy, "learning_starts", -1, "at least 0 and finite"),
    (OffPolicy, "learning_rate_schedule", "kl", "one of constant, linear"),
    (OffPolicy, "network", None, r"a Network\(\)"),
    (OffPolicy, "network", Network(rnn=RNN()), "without rnn: only PPO has memory"),
    *((DQN, name, bad, "between 0 and 1") for name in (
        "exploration_fraction", "exploration_initial_eps", "exploration_final_eps",
    ) for bad in (-0.1, 1.1, NAN)),
    (DQN, "target_update_interval", 0, "at least 1"),
    (DQN, "n_atoms", 1, "at least 2"),
    (DQN, "v_max", -10.0, r"more than v_min \(-10\.0\)"),
    (DQN, "v_max", NAN, "a finite number"),
    (DQN, "v_max", None, "a finite number"),  # as v_min is
    (DQN, "loss", "mae", "one of huber, mse"),
    *((TD3, name, bad, "at least 0 and finite") for name in (
        "exploration_noise", "target_noise", "target_noise_clip", "action_l2",
    ) for bad in (-0.1, INF, NAN)),
    *((TD3, "actor_rate", bad, "positive and finite") for bad in (0.0, -1.0, INF, NAN)),
    *((kind, "policy_delay", 0, "at least 1") for kind in (TD3, SAC)),
    *((kind, "critic", (64,), r"a Network\(\) or None") for kind in (TD3, SAC, PPO)),
    *((SAC, "ent_coef", bad, "positive and finite") for bad in (0.0, -1.0, INF, NAN)),
    (PPO, "network", "mlp", r"a Network\(\)"),
    (PPO, "ent_coef_final", -0.1, "at least 0 and finite"),
    (PPO, "ent_coef_final", INF, "at least 0 and finite"),
    (PPO, "action_std", "network", "one of parameter, state"),
]  # fmt: skip


def fails(kind: type, name: str, value: object, asked: str) -> None:
    with pytest.raises(SkillweaveError, match=rf"{kind.__name__}\.{name} is .*must be {asked}$"):
        kind(**{**({"v_min": -10.0} if name == "v_max" else {}), name: value})


@pytest.mark.parametrize(("kind", "name", "value", "asked"), RANGES)
def test_a_setting_out_of_range_is_named_with_what_it_must_be(kind, name, value, asked):
    for each in (DQN, TD3, SAC) if kind is OffPolicy else (kind,):
        fails(each, name, value, asked)


@pytest.mark.parametrize("kind", [OffPolicy, DQN, TD3, SAC])
def test_every_setting_that_has_a_range_is_tried(kind):
    free = {"bool", "float | None"}  # on or off; and the entropy aimed at: see below
    own = {f.name for f in fields(kind) if f.type not in free}
    inherited = set() if kind is OffPolicy else {f.name for f in fields(OffPolicy)}
    tried = {name for k, name, *_ in RANGES if k is kind}
    assert own - inherited - tried - {"v_min"} == set()  # v_max is held against it


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (DQN, {"v_max": INF, "v_min": 0.0}),
        (DQN, {"v_min": -INF, "v_max": 0.0}),
        (DQN, {"v_min": None, "v_max": 0.0}),
        (SAC, {"target_entropy": NAN}),
        (SAC, {"target_entropy": INF}),
        (SAC, {"critic": Network(rnn=RNN())}),
        (TD3, {"critic": Network(rnn=RNN())}),
        (PPO, {"critic": Network(rnn=RNN())}),
        (PPO, {"num_envs": "4"}),
        (PPO, {"gamma": None}),
        (DQN, {"batch_size": 2.5}),
        (SAC, {"learning_rate": "fast"}),
        (TD3, {"num_envs": True}),
    ],
)
def test_a_setting_that_cannot_work_is_named(kind, settings):
    with pytest.raises(SkillweaveError, match=rf"{kind.__name__}\.{next(iter(settings))} is "):
        kind(**settings)


@pytest.mark.parametrize(
    "config",
    [
        DQN.rainbow(buffer_size=100, learning_starts=7),
        TD3.ddpg(critic=Network((8,), "relu", True)),
        SAC(target_entropy=-3.0, network=Network(cnn=CNN.impala((4,)))),
        PPO(network=Network(rnn=RNN("gru", 5), encoder="mine", cnn=CNN.small())),
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
        ({"momentum": 1}, "SAC has no field momentum"),
        ({"network": {"cnn": {"depth": 3}}}, r"SAC\.network\.cnn has no field depth"),
        ({"network": {"rnn": {"kind": "elman"}}}, r"rnn\.kind is 'elman'; .* lstm, gru"),
        ({"network": {"rnn": {"kind": "gru"}}}, r"SAC\.network is .*only PPO has memory"),
    ],
)
def test_unknown_settings_in_json_are_named(change, says):
    with pytest.raises(SkillweaveError, match=says):
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


def test_the_rate_is_constant_or_falls_to_nothing():
    for schedule, rates in (("constant", [0.1] * 3), ("linear", [0.1, 0.05, 0.0])):
        config = DQN(learning_rate=0.1, learning_rate_schedule=schedule)
        algorithm = make_algorithm(config, Discrete(2), Discrete(2))
        state = algorithm.init([Seeds(0)])
        found = [algorithm.rate(state, p).item() for p in (0.0, 0.5, 1.0)]
        assert found == pytest.approx(rates)


def test_what_follows_an_end_may_be_anything():
    reward, discount = torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 0.5]])
    target = td_target(reward, discount, torch.tensor([[NAN, 8.0]]))
    assert target.tolist() == [[1.0, 6.0]]


def test_weights_of_prioritised_replay_count():
    loss, weight = torch.tensor([[1.0, 3.0]]), torch.tensor([[1.0, 0.5]])
    assert weighted_mean(loss, None).tolist() == [2.0]
    assert weighted_mean(loss, weight).tolist() == [1.25]


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


def test_a_step_of_the_critics_clips_both_together():
    algorithm = make_algorithm(
        replace(SAC(), network=Network((4,)), max_grad_norm=1e-3),
        Box(-1, 1, (3,)),
        Box(-1, 1, (1,)),
    )
    state = algorithm.init([Seeds(0)])
    leaves = algorithm.critics.layout.leaves(state.critic.flatten(0, 1))
    x, action = {"vector": torch.ones(1, 5, 3)}, torch.ones(1, 5, 1)
    loss = 100.0 * algorithm.critics(leaves, x, action).square().mean((1, 2, 3))
    before = state.critic.clone()
    norm = algorithm.critics.step_(state, loss, leaves, torch.tensor([0.1]), 1e-8)
    assert norm.item() > 1.0
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
    algorithm = make_algorithm(config, Box(-1, 1, (3,)), Box(-1, 1, (1,)))
    state = algorithm.init([Seeds(0)])
    assert state.max_grad_norm.tolist() == [LARGEST]
    leaves = algorithm.critics.leaves(state.critic)
    x, action = {"vector": torch.ones(1, 5, 3)}, torch.ones(1, 5, 1)
    loss = 1e6 * algorithm.critics(leaves, x, action).square().mean((1, 2, 3))
    norm = algorithm.critics.step_(state, loss, leaves, torch.tensor([0.1]), 1e-8)
    assert norm.item() > 1e3
    assert state.critic_mu.norm().item() == pytest.approx(0.1 * norm.item(), rel=1e-4)


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
