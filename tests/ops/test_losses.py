import math

import pytest
import torch

from skillweave.ops.losses import (
    approximate_kl,
    categorical_projection,
    conservative_cost,
    expectile_loss,
    likelihood_ratio,
    ppo_policy_loss,
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


def test_an_expectile_leans_to_the_side_that_costs_more():
    value = torch.tensor([[1.0, 1.0]])
    target = torch.tensor([[3.0, -1.0]])
    assert expectile_loss(value, target, 0.7).tolist() == [pytest.approx([0.7 * 4, 0.3 * 4])]
    # The value of least loss of two equally likely targets 0 and 1 is the expectile itself.
    values = torch.linspace(0, 1, 101)[None]
    loss = expectile_loss(values, torch.zeros(1, 101), 0.9)
    loss = loss + expectile_loss(values, torch.ones(1, 101), 0.9)
    assert values[0, loss.argmin()].item() == pytest.approx(0.9)


def test_the_conservative_cost_is_what_other_actions_promise_beyond_those_of_the_data():
    q = torch.tensor([[[1.0, 3.0, 50.0]]])
    action = torch.tensor([[0]])
    allowed = torch.tensor([[[True, True, False]]])
    assert conservative_cost(q, action, allowed).item() == pytest.approx(
        math.log(math.exp(1.0) + math.exp(3.0)) - 1.0
    )
    assert conservative_cost(q, action, None).item() == pytest.approx(49.0, abs=1e-3)
