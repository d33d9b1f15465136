"""What every algorithm says that an observation is worth, by hand: one line for each network."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from gymnasium.spaces import Box, Discrete
from off_policy_cases import critics, line
from torch.distributions import Categorical

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.config import DQN, PPO, SAC, TD3
from skillweave.algorithms.registry import make_algorithm
from skillweave.networks.config import RNN, Network

P, B, A = 2, 5, 3
LINE = {"network": Network(()), "normalize_obs": False}
X = torch.randn(P, B, 2, generator=torch.Generator().manual_seed(0))
MASK = torch.tensor([True, False, True]).expand(P, B, A)


def made(config, space) -> tuple[Any, Any]:
    algorithm = make_algorithm(config, Box(-1, 1, (2,)), space)
    state = algorithm.init([Seeds(m) for m in range(P)])
    g = torch.Generator().manual_seed(1)
    for name in ("params", "target", "critic", "critic_target"):
        if hasattr(state, name):
            getattr(state, name).add_(torch.randn(getattr(state, name).shape, generator=g))
    state.return_mean, state.return_var = (
        torch.tensor([[3.0], [-1.0]]),
        torch.tensor([[4.0], [9.0]]),
    )
    return algorithm, state


def smaller(algorithm, state, m: int, *parts: torch.Tensor) -> torch.Tensor:
    """The smaller of two critics, (B, out)."""
    return critics(algorithm, state.critic, m, torch.cat(parts, -1)).min(0).values


def assert_worth(algorithm, state, mask, expected: list[torch.Tensor]):
    found = algorithm.value(state, X, mask)
    assert found.shape == (P, B)
    torch.testing.assert_close(found, torch.stack(expected), rtol=1e-4, atol=1e-5)


def test_ppos_is_its_critics_in_units_of_reward_with_a_memory_at_the_start_of_an_episode():
    algorithm, state = made(PPO(**LINE), Discrete(A))
    views = algorithm.layout.views(state.params)
    raw = [line(views, "critic", m, X[m])[:, 0] for m in range(P)]
    assert_worth(algorithm, state, None, [2.0 * raw[0] + 3.0, 3.0 * raw[1] - 1.0])
    network = Network((), rnn=RNN("gru", 4))
    algorithm, state = made(PPO(network=network, normalize_obs=False), Discrete(A))
    views = algorithm.layout.views(state.params)
    raw = algorithm.critic_net.step(views, {"vector": X}, torch.zeros(P, B, 4))[0][..., 0]
    assert_worth(algorithm, state, None, [2.0 * raw[0] + 3.0, 3.0 * raw[1] - 1.0])


@pytest.mark.parametrize("mask", [None, MASK], ids=["free", "masked"])
@pytest.mark.parametrize("scaled", [False, True])
def test_dqns_is_the_best_allowed_action(mask, scaled):
    algorithm, state = made(DQN(**LINE, normalize_rewards=scaled), Discrete(A))
    views, units = algorithm.layout.views(state.params), [2.0, 3.0] if scaled else [1.0, 1.0]
    expected = []
    for m in range(P):
        q = line(views, "q", m, X[m])
        allowed = q if mask is None else q[:, [0, 2]]
        expected.append(units[m] * allowed.max(-1).values)
    assert_worth(algorithm, state, mask, expected)


@pytest.mark.parametrize("bounds", [(-1.0, 2.0), (None, None)])
def test_of_c51_it_is_the_mean_of_the_best_allowed_actions_distribution(bounds):
    config = DQN(**LINE, distributional=True, n_atoms=4, v_min=bounds[0], v_max=bounds[1])
    algorithm, state = made(config, Discrete(A))
    low, high = (-10.0, 10.0) if bounds[0] is None else bounds
    atoms = torch.tensor([low + i * (high - low) / 3 for i in range(4)])
    # Without bounds of its own, in units of the returns' root mean square: √(4 + 9), √(9 + 1).
    units = [math.sqrt(13), math.sqrt(10)] if bounds[0] is None else [1.0, 1.0]
    views, expected = algorithm.layout.views(state.params), []
    for m in range(P):
        p = line(views, "q", m, X[m]).view(B, A, 4).softmax(-1)
        expected.append(units[m] * (p @ atoms)[:, [0, 2]].max(-1).values)
    assert_worth(algorithm, state, MASK, expected)


@pytest.mark.parametrize("mask", [None, MASK], ids=["free", "masked"])
def test_sacs_of_discrete_actions_is_the_soft_value(mask):
    config = SAC(**LINE, ent_coef=0.3, normalize_rewards=True)
    algorithm, state = made(config, Discrete(A))
    views, expected = algorithm.layout.views(state.params), []
    for m in range(P):
        logits = line(views, "actor", m, X[m])
        law = Categorical(logits=logits if mask is None else logits.masked_fill(~mask[m], -1e9))
        q = smaller(algorithm, state, m, X[m])
        soft = (law.probs * q).sum(-1) + 0.3 * law.entropy()
        expected.append((2.0, 3.0)[m] * soft)
    assert_worth(algorithm, state, mask, expected)


def test_sacs_of_continuous_actions_is_the_greedy_ones_with_the_entropy():
    algorithm, state = made(SAC(**LINE, ent_coef=0.3), Box(-1, 1, (2,)))
    views, expected = algorithm.layout.views(state.params), []
    for m in range(P):
        mean, log_std = line(views, "actor", m, X[m]).chunk(2, -1)
        action = mean.tanh()
        spread = log_std.clamp(-5, 2) + 0.5 * math.log(2 * math.pi * math.e)
        entropy = (spread + (1 - action.square()).log()).sum(-1)
        expected.append(smaller(algorithm, state, m, X[m], action)[:, 0] + 0.3 * entropy)
    assert_worth(algorithm, state, None, expected)


def test_td3s_is_the_smaller_critics_of_its_own_action():
    algorithm, state = made(TD3(**LINE, normalize_rewards=True), Box(-1, 1, (2,)))
    views, expected = algorithm.layout.views(state.params), []
    for m in range(P):
        action = line(views, "actor", m, X[m]).tanh()
        expected.append((2.0, 3.0)[m] * smaller(algorithm, state, m, X[m], action)[:, 0])
    assert_worth(algorithm, state, None, expected)
