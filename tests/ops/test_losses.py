import math

import pytest
import torch

from skillweave.ops.losses import approximate_kl, ppo_policy_loss, value_loss


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
