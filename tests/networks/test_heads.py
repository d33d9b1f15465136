import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from torch.distributions import (
    Categorical,
    Independent,
    Normal,
    TanhTransform,
    TransformedDistribution,
)

from skillweave._internal.seeding import Seeds
from skillweave.networks.heads import LOG_STD, ActionHead
from skillweave.ops.distributions import clamp_inward
from skillweave.spaces import action_codec

P, B = 2, 5
UNEQUAL = MultiDiscrete([3, 1, 5, 2])


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def laws(head: torch.Tensor, mask: torch.Tensor | None, parts: list[int]) -> list[Categorical]:
    logits = head if mask is None else head.masked_fill(~mask, -1e9)
    return [Categorical(logits=x) for x in logits.split(parts, -1)]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    ("space", "parts"), [(UNEQUAL, [3, 1, 5, 2]), (MultiBinary(3), [2] * 3), (Discrete(4), [4])]
)
def test_choices_are_independent_categoricals(space, parts, masked, generator):
    head = ActionHead(action_codec(space))
    assert head.width == sum(parts)
    logits = 2.0 * torch.randn(P, B, head.width, generator=generator)
    mask = None
    if masked:
        mask = torch.rand(P, B, head.width, generator=generator) < 0.5
        first = np.cumsum([0, *parts[:-1]])
        mask[..., first] = True
    action = torch.stack([law.sample() for law in laws(logits, mask, parts)], -1)
    action = action if head.codec.multi else action[..., 0]
    log_prob, entropy = head.stats(logits, None, mask, action)
    each = action if head.codec.multi else action[..., None]
    torch.testing.assert_close(
        log_prob, sum(law.log_prob(each[..., i]) for i, law in enumerate(laws(logits, mask, parts)))
    )
    torch.testing.assert_close(entropy, sum(law.entropy() for law in laws(logits, mask, parts)))


@pytest.mark.parametrize("parts", [[3, 1, 5, 2], [2, 2, 2]])
def test_choices_are_sampled_by_their_probabilities_and_greedy_ones_are_the_likeliest(parts):
    space = MultiDiscrete(parts) if parts[0] == 3 else MultiBinary(3)
    head, n = ActionHead(action_codec(space)), 40_000
    logits = torch.randn(1, 1, sum(parts), generator=torch.Generator().manual_seed(3))
    logits = logits.expand(1, n, sum(parts))
    noise = head.noise([Seeds(0).torch()], 1, n)[0]
    assert noise.shape == (1, n, sum(parts))
    action, greedy = head.act(logits, None, noise)[0], head.act(logits, None, None)[0]
    assert action.shape == (n, len(parts))
    for i, part in enumerate(logits[0, 0].split(parts)):
        frequency = action[:, i].bincount(minlength=parts[i]) / n
        torch.testing.assert_close(frequency, part.softmax(-1), rtol=0, atol=0.01)
        assert (greedy[:, i] == part.argmax()).all()
    # Independent of each other:
    both = (action[:, 0] == 0) & (action[:, -1] == 0)
    product = (action[:, 0] == 0).float().mean() * (action[:, -1] == 0).float().mean()
    assert both.float().mean().item() == pytest.approx(product.item(), abs=0.01)


@pytest.mark.parametrize("std", ["parameter", "state"])
def test_the_normals_log_density_and_entropy_are_torchs(std, generator):
    head = ActionHead(action_codec(Box(-1, 1, (3,))), std)
    assert head.width == (6 if std == "state" else 3)
    raw = torch.randn(P, B, head.width, generator=generator)
    log_std = None if std == "state" else torch.randn(P, 1, 3, generator=generator)
    mean = raw[..., :3]
    deviation = raw[..., 3:].exp() if std == "state" else log_std.exp().expand_as(mean)
    law = Independent(Normal(mean, deviation), 1)
    action = law.sample()
    log_prob, entropy = head.stats(raw, log_std, None, action)
    torch.testing.assert_close(log_prob, law.log_prob(action))
    torch.testing.assert_close(entropy, law.entropy())
    noise = torch.randn(P, B, 3, generator=generator)
    torch.testing.assert_close(head.act(raw, log_std, noise), mean + deviation * noise)
    assert torch.equal(head.act(raw, log_std, None), mean)


def test_a_deviation_that_depends_on_the_state_stays_in_its_range():
    head = ActionHead(action_codec(Box(-1, 1, (1,))), "state")
    raw = torch.tensor([[[0.0, -9.0], [0.0, 9.0], [0.0, 1.0]]])
    assert head.moments(raw, None)[1].flatten().tolist() == [*LOG_STD, 1.0]


def test_a_deviation_out_of_its_range_learns_to_come_back_and_not_to_go_further():
    x = torch.tensor([-9.0, -9.0, 0.0, 0.0, 9.0, 9.0], requires_grad=True)
    slope = torch.tensor([-2.0, 2.0, -2.0, 2.0, -2.0, 2.0])  # a step goes against it
    (clamp_inward(x, -5.0, 2.0) * slope).sum().backward()
    assert x.grad.tolist() == [-2.0, 0.0, -2.0, 2.0, 0.0, 2.0]


@pytest.mark.parametrize("std", ["parameter", "state"])
def test_entropy_is_worth_less_beyond_the_deviation_that_fills_the_range(std):
    head = ActionHead(action_codec(Box(-1, 1, (2,))), std)
    log = torch.tensor([[[-1.0, -0.5], [0.5, 1.5]]], requires_grad=True)
    mean = torch.zeros(1, 2, 2)
    raw, log_std = (mean, log) if std == "parameter" else (torch.cat([mean, log], -1), None)
    surplus = head.surplus(raw, log_std)
    assert surplus.tolist() == [[0.0, 4.0]]  # twice the 0.5 + 1.5 nats beyond a deviation of 1
    worth = head.stats(raw, log_std, None, mean)[1] - surplus
    worth.sum().backward()
    assert log.grad.tolist() == [[[1.0, 1.0], [-1.0, -1.0]]]


def test_only_dimensions_with_two_bounds_have_a_widest_deviation():
    space = Box(np.array([-1.0, 0.0, -np.inf]), np.array([1.0, np.inf, np.inf]), dtype=np.float64)
    head = ActionHead(action_codec(space))
    log_std = torch.tensor([1.0, 2.0, 4.0]).view(1, 1, 3)
    assert head.surplus(torch.zeros(1, 5, 3), log_std).tolist() == [[2.0] * 5]
    wide = torch.full((1, 1, 2), 3.0)
    for other, squash, own in (
        (Discrete(3), False, None),
        (Box(-1, 1, (2,)), True, wide),
        (Box(-np.inf, np.inf, (2,)), False, wide),
    ):
        head = ActionHead(action_codec(other), "parameter", squash)
        assert head.surplus(torch.zeros(1, 1, head.width), own) is None


@pytest.mark.parametrize("std", ["parameter", "state"])
def test_a_squashed_log_probability_is_that_of_torchs_transformed_distribution(std, generator):
    head = ActionHead(action_codec(Box(-1, 1, (3,))), std, squash=True)
    raw = torch.randn(P, B, head.width, generator=generator)
    log_std = None if std == "state" else torch.randn(P, 1, 3, generator=generator)
    mean, log = head.moments(raw, log_std)
    normal = Normal(mean.double(), log.double().exp().expand_as(mean))
    law = TransformedDistribution(normal, TanhTransform(cache_size=1))
    u = head.act(raw, log_std, torch.randn(P, B, 3, generator=generator))
    squashed = law.transforms[0](u.double())
    log_prob, entropy = head.stats(raw, log_std, None, u)
    expected = law.log_prob(squashed).sum(-1)
    torch.testing.assert_close(log_prob, expected.float(), rtol=1e-4, atol=1e-4)
    # The entropy's one sample: that of the normal and the log-derivative at the action.
    bend = (1 - squashed**2).log().sum(-1)
    expected = normal.entropy().sum(-1) + bend
    torch.testing.assert_close(entropy, expected.float(), rtol=1e-3, atol=1e-3)


def test_the_squashed_entropys_gradient_follows_the_sample(generator):
    head = ActionHead(action_codec(Box(-1, 1, (1,))), "parameter", squash=True)
    mean = torch.zeros(1, 1, 1, requires_grad=True)
    log_std = torch.zeros(1, 1, 1, requires_grad=True)
    z = torch.tensor([[[0.7]]])
    head.stats(mean, log_std, None, z.clone())[1].sum().backward()
    # d/du log(1 − tanh² u) = −2·tanh u, and u = mean + std·z.
    slope = -2.0 * torch.tanh(z).item()
    assert mean.grad.item() == pytest.approx(slope, rel=1e-5)
    assert log_std.grad.item() == pytest.approx(1.0 + slope * 0.7, rel=1e-5)


def test_only_a_squashed_box_is_bent_on_its_way_to_the_environment():
    action = np.array([[0.5], [3.0], [-9.0]], np.float32)
    space = Box(-2.0, 4.0, (1,))
    squashed = ActionHead(action_codec(space), squash=True).to_env(action)
    assert squashed[:, 0].tolist() == pytest.approx((1 + 3 * np.tanh(action[:, 0])).tolist())
    clipped = ActionHead(action_codec(space)).to_env(action)
    assert clipped[:, 0].tolist() == [2.5, 4.0, -2.0]
    chosen = np.array([1, 0])
    assert ActionHead(action_codec(Discrete(2)), squash=True).to_env(chosen).tolist() == [1, 0]
