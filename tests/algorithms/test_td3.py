"""TD3's numbers by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from gymnasium.spaces import Box
from off_policy_cases import generators
from toys import transitions

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.config import TD3
from skillweave.algorithms.td3 import State, TD3Algorithm
from skillweave.networks.config import Network
from skillweave.ops.losses import critic_loss as regression

P, B, A = 2, 6, 2
FORCES = Box(-1, 1, (A,))
LINEAR = TD3(num_envs=2, network=Network(()), learning_rate=1e-2)


def make(**settings) -> tuple[TD3Algorithm, State]:
    algorithm = TD3Algorithm(replace(LINEAR, **settings), Box(-1, 1, (3,)), FORCES)
    state = algorithm.init([Seeds(m) for m in range(P)])
    g = torch.Generator().manual_seed(1)
    for name in ("params", "target", "critic", "critic_target"):
        flat = getattr(state, name)
        flat += 0.3 * torch.randn(flat.shape, generator=g)
    return algorithm, state


def force(algorithm: TD3Algorithm, flat: torch.Tensor, m: int, obs: torch.Tensor) -> torch.Tensor:
    views = algorithm.layout.views(flat)
    return (obs @ views["actor.0.weight"][m] + views["actor.0.bias"][m, 0]).tanh()


def worth(algorithm: TD3Algorithm, critic: torch.Tensor, obs, action) -> torch.Tensor:
    """One critic's (D,) value."""
    views = algorithm.critics.layout.views(critic[None])
    x = torch.cat([obs, action], -1)
    return (x @ views["critic.0.weight"][0] + views["critic.0.bias"][0, 0])[..., 0]


def critic_loss(algorithm: TD3Algorithm, state: State, s: Sample):
    noise = algorithm.learning_noise(generators(), B, False)
    target = algorithm.critic_target(state, s, ActingParams({}, None, None), noise)
    q = algorithm.critics.chosen(algorithm.critics.views(state.critic), {"vector": s.obs}, s.action)
    return regression(q, target, s.weight)


@pytest.mark.parametrize("twin", [True, False])
@pytest.mark.parametrize("noise", [0.0, 0.2, 5.0])
def test_the_target_is_smoothed_by_clipped_noise_and_the_smaller_of_two(twin, noise):
    algorithm, state = make(twin=twin, target_noise=noise, target_noise_clip=0.3)
    s = transitions(FORCES, (P, B))
    total, error, mean = critic_loss(algorithm, state, s)
    for m, g in enumerate(generators()):
        action = force(algorithm, state.target, m, s.next_obs[m])
        if noise:
            normal = torch.randn(B, A, generator=g)
            moved = (noise * normal).clamp(-0.3, 0.3)
            assert (noise < 1) or (moved.abs() > 0.29).any()
            action = (action + moved).clamp(-1, 1)
        slow = [worth(algorithm, c, s.next_obs[m], action) for c in state.critic_target[m]]
        fast = [worth(algorithm, c, s.obs[m], s.action[m]) for c in state.critic[m]]
        assert len(slow) == (2 if twin else 1)
        smallest = torch.stack(slow).min(0).values
        if twin:
            assert not torch.equal(smallest, slow[0])
            assert not torch.equal(smallest, slow[1])
        target = s.reward[m] + s.discount[m] * smallest
        assert target[0] == s.reward[m, 0]
        gaps = torch.stack(fast) - target
        torch.testing.assert_close(total[m], (0.5 * gaps**2 * s.weight[m]).sum(0).mean())
        torch.testing.assert_close(error[m], gaps.abs().mean(0))
        torch.testing.assert_close(mean[m], torch.stack(fast).mean())


def test_the_actor_climbs_the_first_critic():
    algorithm, state = make(action_l2=0.0)
    s = transitions(FORCES, (P, B), weighted=False)
    flat = state.params.clone().requires_grad_()
    algorithm.policy_loss(algorithm.layout.views(flat), state, {"vector": s.obs}).sum().backward()
    for m in range(P):
        leaf = state.params.clone().requires_grad_()
        action = force(algorithm, leaf, m, s.obs[m])
        (-worth(algorithm, state.critic[m, 0], s.obs[m], action).mean()).backward()
        torch.testing.assert_close(flat.grad[m], leaf.grad[m])


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_actor_and_targets_follow_with_a_delay(delay):
    algorithm, state = make(policy_delay=delay, tau=0.25)
    names = ("params", "target", "critic_target")
    for step in range(1, 7):
        before = {k: getattr(state, k).clone() for k in (*names, "critic")}
        algorithm.update(state, transitions(FORCES, (P, B), weighted=False), generators())
        assert not torch.equal(state.critic, before["critic"])
        due = step % delay == 0
        assert [not torch.equal(getattr(state, k), before[k]) for k in names] == [due] * 3
        if due:
            moved = before["target"] + 0.25 * (state.params - before["target"])
            torch.testing.assert_close(state.target, moved)
            moved = before["critic_target"] + 0.25 * (state.critic - before["critic_target"])
            torch.testing.assert_close(state.critic_target, moved)
    assert state.count.tolist() == [6 // delay] * P


def test_each_member_explores_with_its_own_noise_within_the_bounds():
    algorithm, state = make(exploration_noise=0.5)
    state.exploration_noise = torch.tensor([0.0, 0.5])
    obs, noise = torch.zeros(P, 4000, 3), algorithm.noise(generators(), 1, 4000)[0]
    action, _, _ = algorithm.act(algorithm.acting_params(state), obs, None, noise)
    greedy, _, _ = algorithm.act(algorithm.acting_params(state), obs, None, None)
    assert torch.equal(action[0], greedy[0])
    expected = (greedy[1] + 0.5 * noise[1]).clamp(-1, 1)
    torch.testing.assert_close(action[1], expected)
    assert action.abs().max() == 1.0


def test_ddpg_is_td3_without_its_additions():
    config = TD3.ddpg(tau=0.1)
    assert (config.twin, config.policy_delay, config.target_noise) == (False, 1, 0.0)
    assert (config.tau, config.action_l2) == (0.1, 0.0)
    assert make(twin=False)[1].critic.shape[1] == 1


def test_large_outputs_before_tanh_cost_a_share_of_the_size_of_values():
    algorithm, state = make(action_l2=0.5)
    leaf = state.params.clone().requires_grad_()
    inputs = algorithm.inputs(algorithm.acting_params(state), torch.ones(P, 6, 3))
    views = algorithm.layout.views(leaf)
    q = algorithm.critics(
        algorithm.critics.views(state.critic[:, :1]), inputs, algorithm.net(views, inputs).tanh()
    )
    size = algorithm.net(views, inputs).square().mean((1, 2))
    # The size of values is held fixed: they are not made small so that outputs cost less.
    by_hand = 0.5 * q.detach().abs().mean((1, 2, 3)) * size - q.mean((1, 2, 3))
    expected = torch.autograd.grad(by_hand.sum(), leaf)[0]
    loss = algorithm.policy_loss(views, state, inputs)
    torch.testing.assert_close(loss, by_hand)
    found = torch.autograd.grad(loss.sum(), leaf)[0]
    torch.testing.assert_close(found, expected)


def test_the_actors_rate_is_a_share_of_the_critics():
    moved = {}
    for share in (1.0, 0.25):
        algorithm, state = make(actor_rate=share, policy_delay=1)
        before = state.params.clone(), state.critic.clone()
        algorithm.update(state, transitions(FORCES, (P, B), weighted=False), generators())
        moved[share] = state.params - before[0], state.critic - before[1]
    # Adam's first step is the rate times the gradient's sign
    torch.testing.assert_close(moved[0.25][0], 0.25 * moved[1.0][0], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(moved[0.25][1], moved[1.0][1])
