"""The distribution of actions with several parts, in numbers by hand."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from reach import SPACES
from torch.distributions import Categorical, Normal, kl_divergence

from skillweave.networks.heads import head_of
from skillweave.policies.spaces import space_of
from skillweave.spaces import JointCodec, action_codec, obs_dtype, put_observation

SPACE = gym.spaces.Dict(
    arm=gym.spaces.Box(-2, 2, (2,), np.float32),
    grip=gym.spaces.Discrete(3),
    more=gym.spaces.Tuple((gym.spaces.MultiBinary(2), gym.spaces.Box(5, 8, (1,), np.int64))),
)


@pytest.fixture
def head():
    return head_of(action_codec(SPACE))


def parts_of(params):
    """Split parameters by hand: 2 means, 3 logits, 2 + 2 logits of bits, 4 logits."""
    return params.split([2, 3, 2, 2, 4], dim=-1)


def by_hand(params, log_std):
    mean, *logits = parts_of(params)
    return [Normal(mean, log_std.exp()), *(Categorical(logits=x) for x in logits)]


def drawn(head, n=300):
    torch.manual_seed(0)
    params, log_std = torch.randn(1, n, head.width), torch.tensor([[[-0.5, 0.3]]])
    noise = head.noise([torch.Generator().manual_seed(1)], 1, n)[0]
    return params, log_std, head.act(params, log_std, noise)


def test_log_probability_and_entropy_are_sums_over_the_parts(head):
    params, log_std, action = drawn(head)
    assert action.shape == (1, 300, 6)  # 2 numbers, a choice, two bits, a whole number
    normal, *choices = by_hand(params, log_std)
    expected = normal.log_prob(action[..., :2]).sum(-1)
    spread = normal.entropy().sum(-1)
    for i, choice in enumerate(choices):
        expected = expected + choice.log_prob(action[..., 2 + i])
        spread = spread + choice.entropy()
    log_prob, entropy = head.stats(params, log_std, None, action)
    assert torch.allclose(log_prob, expected, atol=1e-5)
    assert torch.allclose(entropy, spread, atol=1e-5)


def test_kl_is_the_sum_over_the_parts(head):
    params, log_std, _ = drawn(head)
    other, other_std = params.flip(1), log_std + 0.2
    pairs = list(zip(by_hand(params, log_std), by_hand(other, other_std), strict=True))
    expected = kl_divergence(*pairs[0]).sum(-1)
    for p, q in pairs[1:]:
        expected = expected + kl_divergence(p, q)
    found = head.kl(params, log_std, other, other_std, None)
    assert torch.allclose(found, expected, atol=1e-4)
    assert torch.equal(head.kl(params, log_std, params, log_std, None), torch.zeros(1, 300))


def test_actions_are_drawn_by_their_probabilities(head):
    params = torch.tensor([[[0.5, -0.5, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.5, 1.0, 1.5]]])
    log_std = torch.tensor([[[-1.0, 0.0]]])
    n = 20_000
    noise = head.noise([torch.Generator().manual_seed(0)], 1, n)[0]
    action = head.act(params.expand(1, n, -1), log_std, noise)[0]
    assert torch.allclose(action[:, :2].mean(0), params[0, 0, :2], atol=0.03)
    assert torch.allclose(action[:, :2].std(0), log_std[0, 0].exp(), atol=0.03)
    for column, logits in zip(range(2, 6), parts_of(params[0, 0])[1:], strict=True):
        share = torch.bincount(action[:, column].long(), minlength=len(logits)) / n
        assert torch.allclose(share, logits.softmax(0), atol=0.02)
    # The parts are independent of each other.
    assert torch.corrcoef(action.T).fill_diagonal_(0).abs().max() < 0.03


@pytest.mark.parametrize("std", ["parameter", "state"])
def test_squashed_parts_stay_within_their_bounds(std):
    head = head_of(action_codec(SPACE), std, squash=True)
    assert head.log_std_size == (2 if std == "parameter" else 0)
    assert head.std_columns == ([] if std == "parameter" else [2, 3])
    params = 3 * torch.randn(1, 50, head.width)
    log_std = torch.zeros(1, 1, 2) if head.log_std_size else None
    action = head.act(params, log_std, None)
    in_env = head.to_env(action[0].numpy())
    assert np.allclose(in_env["arm"], 2 * np.tanh(action[0, :, :2].numpy()), atol=1e-6)
    log_prob, _ = head.stats(params, log_std, None, action)
    assert bool(log_prob.isfinite().all())


@pytest.mark.parametrize("kind", SPACES)
def test_actions_become_numbers_and_back(kind):
    space = SPACES[kind]
    codec = action_codec(space)
    space.seed(0)
    batch = np.zeros((20, *(space.shape or ())), obs_dtype(space))
    samples = [space.sample() for _ in range(20)]
    for i, sample in enumerate(samples):
        put_observation(space, batch, i, sample)
    units = codec.from_env(batch)
    again = codec.to_env(units)
    assert again.dtype == batch.dtype
    for one in again:
        assert space.contains(space_of(space).unpacked(one))
    if isinstance(codec, JointCodec):
        arm, grip = ("arm", "grip") if "arm" in again.dtype.names else ("0", "1")
        assert np.allclose(again[arm], batch[arm], atol=1e-6)
        assert (again[grip] == batch[grip]).all()
    else:
        assert (again == batch).all()
        assert units.min() == 0
        assert units.max(axis=0).tolist() == [2, 5]
