"""SAC's numbers by hand, for continuous and for discrete actions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from off_policy_cases import B, P, critics, generators, line
from torch.distributions import Categorical, Normal, TanhTransform, TransformedDistribution
from toys import Masked, Toy, learn, transitions

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Sample
from skillweave.algorithms.config import SAC
from skillweave.algorithms.sac import SACAlgorithm, State
from skillweave.networks.config import Network
from skillweave.ops.losses import critic_loss, masked_entropy_target

LINEAR = SAC(num_envs=2, network=Network(()), learning_rate=1e-2, normalize_obs=False)
FORCES, CHOICES = Box(-1, 1, (2,)), Discrete(3)


def make(space, **settings) -> tuple[SACAlgorithm, State]:
    algorithm = SACAlgorithm(replace(LINEAR, **settings), Box(-1, 1, (3,)), space)
    state = algorithm.init([Seeds(m) for m in range(P)])
    g = torch.Generator().manual_seed(1)
    for name in ("params", "critic", "critic_target"):
        flat = getattr(state, name)
        flat += 0.3 * torch.randn(flat.shape, generator=g)
    state.log_alpha = torch.tensor([[math.log(0.2)], [math.log(0.7)]])
    return algorithm, state


def squashed(head: torch.Tensor, g: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """A sampled force and its log-probability, by torch's distributions in float64."""
    mean, log_std = head.double().chunk(2, -1)
    std = log_std.clamp(-5, 2).exp()
    u = mean + std * torch.randn(mean.shape, generator=g).double()
    law = TransformedDistribution(Normal(mean, std), TanhTransform(cache_size=1))
    action = law.transforms[0](u)
    return action, law.log_prob(action).sum(-1)


def losses(algorithm: SACAlgorithm, state: State, s: Sample) -> tuple[Any, Any]:
    inputs = {"vector": s.obs}
    noise = algorithm.learning_noise(generators(), s.reward.shape[1], False)
    views = algorithm.layout.views(state.params)
    policy = algorithm.policy_loss(views, state, s.mask, inputs, noise)
    return critic(algorithm, state, s, noise), policy


def critic(algorithm: SACAlgorithm, state: State, s: Sample, noise):
    params = algorithm.acting_params(state)
    target = algorithm.critic_target(state, s, params, noise)
    views = algorithm.critics.views(state.critic)
    q = algorithm.critics.chosen(views, {"vector": s.obs}, s.action)
    return critic_loss(q, target, s.weight)


def test_forces_by_hand():
    algorithm, state = make(FORCES)
    s, alphas = transitions(FORCES, (P, B)), [0.2, 0.7]
    (total, error, _), (policy, entropy) = losses(algorithm, state, s)
    views = algorithm.layout.views(state.params)
    for m in range(P):
        action, log_prob = squashed(line(views, "actor", m, s.next_obs[m]), generators()[m])
        slow = critics(
            algorithm, state.critic_target, m, torch.cat([s.next_obs[m], action.float()], -1)
        )
        soft = slow[..., 0].min(0).values - alphas[m] * log_prob
        target = s.reward[m] + s.discount[m] * soft
        fast = critics(algorithm, state.critic, m, torch.cat([s.obs[m], s.action[m]], -1))
        gaps = fast[..., 0] - target.float()
        cost = (0.5 * gaps**2 * s.weight[m]).sum(0).mean()
        torch.testing.assert_close(total[m], cost, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(error[m], gaps.abs().mean(0), rtol=1e-4, atol=1e-5)
        action, log_prob = squashed(line(views, "actor", m, s.obs[m]), generators()[m])
        q = critics(algorithm, state.critic, m, torch.cat([s.obs[m], action.float()], -1))
        loss = (alphas[m] * log_prob - q[..., 0].min(0).values).mean()
        assert policy[m].item() == pytest.approx(loss.item(), rel=1e-4)
        assert entropy[m].item() == pytest.approx(-log_prob.mean().item(), rel=1e-4)


@pytest.mark.parametrize("masked", [False, True])
def test_choices_by_hand(masked):
    algorithm, state = make(CHOICES)
    s, alphas = transitions(CHOICES, (P, B), masked=masked), [0.2, 0.7]
    (total, error, _), (policy, entropy) = losses(algorithm, state, s)
    views = algorithm.layout.views(state.params)

    def law(m: int, obs: torch.Tensor, mask: torch.Tensor | None) -> Categorical:
        logits = line(views, "actor", m, obs)
        return Categorical(logits=logits if mask is None else logits.masked_fill(~mask[m], -1e9))

    for m in range(P):
        after = law(m, s.next_obs[m], s.next_mask)
        slow = critics(algorithm, state.critic_target, m, s.next_obs[m]).min(0).values
        soft = (after.probs * slow).sum(-1) + alphas[m] * after.entropy()
        target = s.reward[m] + s.discount[m] * soft
        fast = critics(algorithm, state.critic, m, s.obs[m])
        gaps = fast[:, torch.arange(B), s.action[m]] - target
        cost = (0.5 * gaps**2 * s.weight[m]).sum(0).mean()
        torch.testing.assert_close(total[m], cost, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(error[m], gaps.abs().mean(0), rtol=1e-4, atol=1e-5)
        now = law(m, s.obs[m], s.mask)
        q = fast.min(0).values
        loss = -(now.probs * q).sum(-1) - alphas[m] * now.entropy()
        torch.testing.assert_close(policy[m], loss.mean(), rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(entropy[m], now.entropy().mean(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("space", [FORCES, CHOICES], ids=["forces", "choices"])
def test_the_temperature_falls_where_the_entropy_is_above_its_aim_and_rises_below(space):
    algorithm, state = make(space)
    s = transitions(space, (P, B))
    _, (_, entropy) = losses(algorithm, state, s)
    before = state.log_alpha.clone()
    for aim in (entropy.min().item() - 2.0, entropy.max().item() + 2.0):
        algorithm.target_entropy = aim
        state.log_alpha = before.clone()
        for name in ("alpha_mu", "alpha_nu", "alpha_count"):
            getattr(state, name).zero_()
        algorithm.update(state, s, generators())
        # Adam's first step, of d/d log α of log α·(H − H̄): the rate against the sign.
        sign = torch.sign(state.entropy - aim)[:, None]
        torch.testing.assert_close(state.log_alpha, before - 1e-2 * sign)
        torch.testing.assert_close(
            state.alpha_mu[:, 0], 0.1 * (state.entropy - aim), rtol=1e-4, atol=1e-6
        )
    assert sign.tolist() == [[-1.0], [-1.0]]


@pytest.mark.parametrize(
    ("space", "given", "aim"),
    [(FORCES, None, -2.0), (CHOICES, None, 0.5 * math.log(3)), (FORCES, -0.5, -0.5)],
)
def test_the_usual_aim_of_the_entropy(space, given, aim):
    assert make(space, target_entropy=given)[0].target_entropy == pytest.approx(aim)


def test_the_policy_is_delayed_and_the_target_is_not():
    algorithm, state = make(FORCES, policy_delay=2, tau=0.25)
    for due in (False, True, False, True):
        before = {k: getattr(state, k).clone() for k in ("params", "log_alpha", "critic_target")}
        algorithm.update(state, transitions(FORCES, (P, B)), generators())
        assert torch.equal(state.params, before["params"]) != due
        assert torch.equal(state.log_alpha, before["log_alpha"]) != due
        moved = before["critic_target"] + 0.25 * (state.critic - before["critic_target"])
        torch.testing.assert_close(state.critic_target, moved)


def test_greedy_is_the_squashed_mean_and_samples_follow_the_law():
    algorithm, state = make(FORCES)
    obs = torch.randn(P, 5, 3, generator=torch.Generator().manual_seed(5))
    actor, noise = algorithm.acting_params(state), algorithm.noise(generators(), 1, 5)[0]
    greedy, head, _ = algorithm.act(actor, obs, None, None)
    mean, log_std = head.chunk(2, -1)
    torch.testing.assert_close(greedy, mean.tanh())
    sampled, _, _ = algorithm.act(actor, obs, None, noise)
    torch.testing.assert_close(sampled, (mean + log_std.exp() * noise).tanh())
    assert noise.std() > 0.5


@pytest.mark.parametrize("alpha", [0.9, 2.0])
def test_masks_and_a_high_temperature_leave_everything_finite(alpha):
    config = SAC(num_envs=4, batch_size=8, learning_starts=8, buffer_size=100, ent_coef=alpha)
    _, state = learn(replace(config, network=Network((8,))), Masked(4), 40)
    assert state.critic.isfinite().all()
    assert state.params.isfinite().all()


# n steps


@pytest.mark.parametrize("space", [FORCES, CHOICES], ids=["forces", "choices"])
def test_the_entropy_between_n_steps_is_part_of_the_target_by_hand(space):
    algorithm, state = make(space, n_step=3)
    s, alphas, g = transitions(space, (P, B)), [0.2, 0.7], torch.Generator().manual_seed(5)
    between = torch.randn(P, B, 2, 3, generator=g)
    counts = torch.tensor([0.9, 0.5]).expand(P, B, 2).clone()
    counts[:, 1:3, 1] = 0.0  # the steps ended before
    between[:, 1:3, 1] = math.nan
    mask = None
    if space is CHOICES:
        mask = torch.rand(P, B, 2, 3, generator=g) < 0.5
        mask[..., 1] = True
    with_between = replace(
        s, between_obs=between, between_mask=mask, between_discount=counts, weight=None
    )
    noise = algorithm.learning_noise(generators(), B, False)
    _, error, _ = critic(algorithm, state, with_between, noise)
    extra = torch.zeros(P, B)
    own = algorithm.layout.views(state.params)
    for m in range(P):
        head = line(own, "actor", m, between[m].flatten(0, 1))
        if space is CHOICES:
            head = head.masked_fill(~mask[m].flatten(0, 1), -1e9)
            entropy = Categorical(logits=head.nan_to_num()).entropy()
        else:
            chance = generators()[m]
            torch.randn(B, 2, generator=chance)  # of the next actions
            _, log_prob = squashed(head.nan_to_num(), chance)
            entropy = -log_prob.float()
        extra[m] = alphas[m] * (counts[m] * entropy.view(B, 2)).sum(-1)
    without = replace(s, reward=s.reward + extra, weight=None)
    _, expected, _ = critic(algorithm, state, without, noise)
    torch.testing.assert_close(error, expected, rtol=1e-4, atol=1e-5)


class Nothing(Toy):
    """No reward, no end: the soft value of acting is α·log 2·γ/(1 − γ)."""

    def play(self, action):
        still = np.zeros((self.num_envs, 1), np.float32)
        return still, 0.0 * self.ones, self.never, self.never


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("n_step", [1, 3])
def test_the_soft_value_is_the_same_whatever_the_number_of_steps(n_step):
    config = SAC(
        num_envs=8, learning_starts=64, buffer_size=400, batch_size=16, learning_rate=0.1, tau=0.5,
        gamma=0.5, learn_ent_coef=False, n_step=n_step, network=Network(()), update_ratio=0.25,
    )  # fmt: skip
    algorithm, state = learn(config, Nothing(8), 600)
    views = algorithm.critics.views(state.critic)
    q = algorithm.critics(views, {"vector": torch.zeros(1, 1, 1)}).mean().item()
    assert q == pytest.approx(math.log(2), rel=0.01)  # without the steps between 0.099


def test_observations_between_are_drawn_only_where_there_are_some():
    for n_step, sizes in (1, [B, B]), (3, [B, B * 2, B]):
        algorithm, _ = make(FORCES, n_step=n_step)
        noise = algorithm.learning_noise(generators(), B, True)
        assert [x.shape[1] for x in noise] == sizes


# Masks


def test_fewer_choices_are_to_have_less_entropy():
    mask = torch.zeros(2, 2, 8, dtype=torch.bool)
    mask[0, 0, :2] = mask[0, 1, :4] = mask[1, :, :1] = True
    aim, aims = masked_entropy_target(0.5 * math.log(8), mask).tolist(), 0.5 * math.log(8)
    assert aim == pytest.approx([0.5 * (math.log(2) + math.log(4)) / 2, 0.0])
    assert masked_entropy_target(aims, None) == pytest.approx(aims)
    assert masked_entropy_target(aims, torch.ones_like(mask)).tolist() == pytest.approx([aims] * 2)
    assert masked_entropy_target(0.0, torch.ones(1, 2, 1, dtype=torch.bool)) == 0.0


class TwoOfEight(Toy):
    """Two of eight actions are allowed; the second of them pays."""

    action_space = Discrete(8)

    def mask(self):
        return np.tile(np.arange(8) < 2, (self.num_envs, 1))

    def play(self, action):
        still = np.zeros((self.num_envs, 1), np.float32)
        return still, (action == 1) * 1.0, self.t == 1, self.never


@pytest.mark.slow
def test_under_a_mask_the_temperature_does_not_grow_without_bound():
    config = SAC(
        num_envs=8, learning_starts=64, buffer_size=1000, batch_size=16, learning_rate=5e-2,
        network=Network(()), update_ratio=0.25,
    )  # fmt: skip
    _, state = learn(config, TwoOfEight(8), 1200)
    # Aimed at is half of log 2; half of log 8, which is more than log 2, was never reached.
    assert state.log_alpha.exp().item() < 2.0


# Deviations


def test_a_collapsed_deviation_comes_back():
    algorithm, state = make(FORCES)
    bias = algorithm.layout.views(state.params)["actor.0.bias"]
    bias[..., 2:] = -9.0
    for _ in range(10):
        algorithm.update(state, transitions(FORCES, (P, B)), generators())
    # There a deviation costs nothing and entropy pays: every step of Adam is the whole rate.
    assert bias[..., 2:].flatten().tolist() == pytest.approx([-8.9] * 4, abs=0.01)
