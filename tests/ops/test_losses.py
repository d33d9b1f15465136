import math

import pytest
import torch

from skillweave.ops.losses import (
    approximate_kl,
    categorical_projection,
    critic_loss,
    expected_soft_value,
    likelihood_ratio,
    ppo_policy_loss,
    td_loss,
    value_loss,
)


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective", "gradient"),
    [
        (1.1, 2.0, 2.2, 2.2),  # within the range: ρA
        (1.5, 2.0, 2.4, 0.0),  # too far up for a good action: (1 + ε)A, flat
        (0.5, 2.0, 1.0, 1.0),  # a good action that became rare: unclipped, pulled back
        (0.5, -2.0, -1.6, 0.0),  # too far down for a bad action: (1 − ε)A, flat
        (1.5, -2.0, -3.0, -3.0),  # a bad action that became frequent: unclipped
    ],
)
def test_ppo_clips_only_where_the_policy_would_gain(ratio, advantage, objective, gradient):
    log_prob = torch.tensor([[math.log(ratio)]], requires_grad=True)
    loss = ppo_policy_loss(
        log_prob, torch.zeros(1, 1), torch.tensor([[advantage]]), torch.tensor([0.2])
    )
    loss.sum().backward()
    assert loss.tolist() == pytest.approx([-objective])
    assert log_prob.grad.item() == pytest.approx(-gradient)  # d(ρA)/d log π = ρA


def test_ppo_loss_has_one_number_and_one_clip_range_a_member():
    log_prob = torch.log(torch.tensor([[1.5, 1.5], [1.5, 1.5]]))
    loss = ppo_policy_loss(
        log_prob,
        torch.zeros(2, 2),
        torch.tensor([[1.0, 3.0], [1.0, 3.0]]),
        torch.tensor([0.2, 0.4]),
    )
    assert loss.tolist() == pytest.approx([-2.4, -2.8])


def test_value_loss_is_half_the_mean_squared_error():
    value, target = torch.tensor([[1.0, 2.0], [0.0, 0.0]]), torch.tensor([[3.0, 2.0], [1.0, 1.0]])
    assert value_loss(value, target).tolist() == [1.0, 0.5]


@pytest.mark.parametrize(
    ("value", "target", "loss", "gradient"),
    [
        (0.3, 2.0, 0.5 * 1.7**2, -1.7),  # within the clip: plain
        (1.5, 2.0, 0.5 * 1.5**2, 0.0),  # ran ahead upwards: held at 0 + 0.5
        (-1.5, -2.0, 0.5 * 1.5**2, 0.0),  # ran ahead downwards: held at 0 − 0.5
        (1.5, -2.0, 0.5 * 3.5**2, 3.5),  # ran the wrong way: the larger error counts
    ],
)
def test_value_clipping_takes_the_larger_error(value, target, loss, gradient):
    v = torch.tensor([[value]], requires_grad=True)
    got = value_loss(v, torch.tensor([[target]]), torch.zeros(1, 1), torch.tensor([0.5]))
    got.sum().backward()
    assert got.item() == pytest.approx(loss)
    assert v.grad.item() == pytest.approx(gradient)


def test_kl_is_the_k3_estimator():
    old = torch.log(torch.tensor([[0.5, 0.2], [0.5, 0.5]]))
    new = torch.log(torch.tensor([[0.25, 0.4], [0.5, 0.5]]))
    k3 = ((0.5 - 1 - math.log(0.5)) + (2.0 - 1 - math.log(2.0))) / 2
    assert approximate_kl(new, old).tolist() == pytest.approx([k3, 0.0])


def test_kl_approaches_the_true_divergence_on_samples_of_the_old_policy():
    old, new = torch.tensor([0.7, 0.2, 0.1]), torch.tensor([0.5, 0.3, 0.2])
    action = old.multinomial(200_000, replacement=True, generator=torch.Generator().manual_seed(0))
    true = (old * (old / new).log()).sum().item()
    got = approximate_kl(new.log()[action][None], old.log()[action][None])
    assert got.item() == pytest.approx(true, rel=0.02)


@pytest.mark.parametrize(
    ("error", "kind", "loss", "gradient"),
    [
        (0.5, "mse", 0.125, 0.5),
        (-3.0, "mse", 4.5, -3.0),
        (0.5, "huber", 0.125, 0.5),
        (-0.999, "huber", 0.5 * 0.999**2, -0.999),
        (-3.0, "huber", 2.5, -1.0),
    ],
)
def test_a_temporal_difference_costs_half_its_square_or_hubers_loss(error, kind, loss, gradient):
    value = torch.tensor([[2.0 + error, 2.0]], requires_grad=True)
    each = td_loss(value, torch.full((1, 2), 2.0), kind)
    each.sum().backward()
    assert each.tolist()[0] == pytest.approx([loss, 0.0])
    assert value.grad.tolist()[0] == pytest.approx([gradient, 0.0])


def projected(p, atoms, reward: float, discount: float) -> list[float]:
    """Bellemare et al. 2017, algorithm 1."""
    low, high, n = atoms[0], atoms[-1], len(atoms)
    width, mass = (high - low) / (n - 1), [0.0] * n
    for j in range(n):
        at = (min(high, max(low, reward + discount * atoms[j])) - low) / width
        at = round(at, 9)
        below, above = math.floor(at), math.ceil(at)
        if below == above:
            mass[below] += p[j]
        else:
            mass[below] += p[j] * (above - at)
            mass[above] += p[j] * (at - below)
    return mass


def test_a_distribution_is_projected_as_in_the_papers_loop():
    g, atoms = torch.Generator().manual_seed(0), torch.linspace(-2.0, 3.0, 11)
    p = torch.rand(2, 50, 11, generator=g).softmax(-1)
    reward = 3.0 * torch.randn(2, 50, generator=g)
    discount = torch.rand(2, 50, generator=g)
    discount[:, :5] = 0.0
    reward[0, 0], reward[0, 1], reward[0, 2] = -2.0, 3.0, 0.5  # right on an atom
    discount[0, 5], reward[0, 5] = 1.0, 0.0  # stays
    reward[0, 6], reward[0, 7] = -100.0, 100.0  # beyond either end
    got = categorical_projection(p, atoms, reward, discount)
    torch.testing.assert_close(got.sum(-1), torch.ones(2, 50))
    for m in range(2):
        for b in range(50):
            numbers = (p[m, b].tolist(), atoms.tolist(), reward[m, b].item(), discount[m, b].item())
            assert got[m, b].tolist() == pytest.approx(projected(*numbers), abs=1e-5)
    torch.testing.assert_close(got[0, 5], p[0, 5])
    assert [got[0, 6, 0].item(), got[0, 7, -1].item()] == pytest.approx([1.0, 1.0])


def test_a_projection_keeps_the_mean_within_the_atoms():
    atoms = torch.linspace(-10.0, 10.0, 51)
    p = torch.rand(1, 20, 51, generator=torch.Generator().manual_seed(0)).softmax(-1)
    reward, discount = torch.linspace(-1.0, 1.0, 20)[None], torch.full((1, 20), 0.5)
    mean = (categorical_projection(p, atoms, reward, discount) * atoms).sum(-1)
    torch.testing.assert_close(mean, reward + 0.5 * (p * atoms).sum(-1), rtol=1e-4, atol=1e-4)


VALID = torch.tensor([[True, False, True]])


def test_losses_of_ppo_are_means_over_valid_samples():
    g = torch.Generator().manual_seed(0)
    new, old, advantage, weight = (torch.randn(1, 3, generator=g) for _ in range(4))
    clip, kept = torch.tensor([0.2]), [x[:, [0, 2]] for x in (new, old, advantage, weight)]
    found = ppo_policy_loss(new, old, advantage, clip, weight, VALID)
    torch.testing.assert_close(found, ppo_policy_loss(*kept[:3], clip, kept[3]))
    torch.testing.assert_close(
        value_loss(new, old, advantage, clip, VALID), value_loss(*kept[:3], clip)
    )
    found = approximate_kl(new, old, weight, VALID)
    torch.testing.assert_close(found, approximate_kl(kept[0], kept[1], kept[3]))


def test_critics_learn_one_target_by_half_the_squared_error():
    q, target = torch.tensor([[[1.0, 2.0], [3.0, 5.0]]]), torch.tensor([[2.0, 2.0]])
    loss, error, mean = critic_loss(q, target, torch.tensor([[1.0, 0.5]]))
    # Sample 0: ½·(1 + 1); sample 1: ½·(0 + 9), which counts half.
    assert loss.item() == pytest.approx((1.0 + 0.5 * 4.5) / 2)
    assert error.tolist() == [[1.0, 1.5]]
    assert mean.item() == pytest.approx(11 / 4)


def test_the_soft_value_by_hand():
    p, q = torch.tensor([[[0.25, 0.75]]]), torch.tensor([[[4.0, 8.0]]])
    found = expected_soft_value(p.log(), q, torch.tensor([[0.5]]))
    entropy = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    assert found.item() == pytest.approx(7.0 + 0.5 * entropy)


def test_ratios_that_are_not_finite_are_held_at_a_large_number():
    log_prob = torch.tensor([[200.0, -200.0, 200.0]], requires_grad=True)
    old, advantage = torch.zeros(1, 3), torch.tensor([[-1.0, 1.0, 1.0]])
    weight = likelihood_ratio(torch.tensor([[1.0, 1e5, 1.0]]), torch.zeros(1, 3))
    loss = ppo_policy_loss(log_prob, old, advantage, torch.tensor([0.2]), weight)
    loss.sum().backward()
    # −(−e¹·e²⁰ + e²⁰·e⁻²⁰⁰ + e¹·1.2) / 3.
    assert loss.item() == pytest.approx(math.e * (math.exp(20.0) - 1.2) / 3, rel=1e-5)
    assert log_prob.grad.isfinite().all()
    assert approximate_kl(log_prob, old, weight).isfinite().all()


def test_smaller_ratios_are_exact():
    log_prob = torch.tensor([[-3.0, 0.0, 19.0]])
    assert torch.equal(likelihood_ratio(log_prob, torch.zeros(1, 3)), log_prob.exp())
