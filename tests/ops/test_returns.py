import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from skillweave.ops.moments import explained_variance, normalize
from skillweave.ops.returns import discounted, gae, td_target


def one(*numbers: float) -> torch.Tensor:
    """One member, T steps, one environment: (1, T, 1)."""
    return torch.tensor(numbers).reshape(1, -1, 1)


def test_gae_of_another_policy_than_the_one_that_acted():
    # δ₁ = 2 − 5 = −3, δ₀ = 1 + 0.9·5 − 4 = 1.5; of row 1 a quarter counts: 1.5 + 0.45·0.25·(−3)
    rows = one(1.0, 2.0), one(0.9, 0.0), one(4.0, 5.0), one(5.0, 99.0), one(False, True)
    importance = one(0.5, 0.25)
    got = gae(*rows, torch.tensor([0.5]), importance)
    assert got.flatten().tolist() == pytest.approx([1.1625, -3.0])
    # V-trace as it is defined (Espeholt et al. 2018, eq. 1), with λ in its c:
    # v₁ = 5 + 0.25·(−3) = 4.25; v₀ = 4 + 0.5·1.5 + 0.9·(0.5·0.5)·0.25·(−3) = 4.58125
    target = one(4.0, 5.0) + importance * got
    assert target.flatten().tolist() == pytest.approx([4.58125, 4.25])
    everywhere = gae(*rows, torch.tensor([0.5]), torch.ones(1, 2, 1))
    torch.testing.assert_close(everywhere, gae(*rows, torch.tensor([0.5])), atol=0, rtol=0)


def test_gae_ignores_the_next_value_where_the_discount_is_zero_even_if_it_is_not_a_number():
    # A physics engine may well terminate *because* its last observation is not finite.
    rows = one(1.0, 2.0), one(0.9, 0.0), one(4.0, 5.0), one(5.0, float("nan")), one(False, True)
    found = gae(*rows, torch.tensor([0.5]))
    assert found.flatten().tolist() == pytest.approx([0.15, -3.0], abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_gae_equals_the_scalar_recursion_for_every_member_and_environment(seed):
    rng = np.random.default_rng(seed)
    p, t, b = rng.integers(1, 5, 3)
    reward, value, next_value = rng.normal(size=(3, p, t, b))
    discount, last = rng.uniform(size=(p, t, b)), rng.uniform(size=(p, t, b)) < 0.3
    lam, expected = rng.uniform(size=p), np.zeros((p, t, b))
    for i, k in np.ndindex(p, b):
        tail = 0.0
        for j in reversed(range(t)):
            delta = reward[i, j, k] + discount[i, j, k] * next_value[i, j, k] - value[i, j, k]
            tail = delta + (0.0 if last[i, j, k] else discount[i, j, k] * lam[i] * tail)
            expected[i, j, k] = tail
    tensors = [torch.from_numpy(x) for x in (reward, discount, value, next_value, last, lam)]
    np.testing.assert_allclose(gae(*tensors).numpy(), expected, rtol=1e-9, atol=1e-12)


def test_normalize_works_on_each_member_by_itself():
    x = torch.stack([torch.arange(6.0), 100.0 * torch.arange(6.0) + 7.0]).reshape(2, 3, 2)
    y = normalize(x)
    torch.testing.assert_close(y.flatten(1).mean(1), torch.zeros(2), atol=1e-6, rtol=0)
    torch.testing.assert_close(y.flatten(1).std(1, unbiased=False), torch.ones(2))
    torch.testing.assert_close(y[0], y[1], atol=1e-5, rtol=0)


def test_explained_variance_is_one_for_the_target_and_zero_for_a_constant():
    target = torch.tensor([[1.0, 2.0, 3.0, 4.0]]).expand(3, 4)
    value = torch.stack([target[0], torch.full((4,), 9.0), torch.tensor([4.0, 3.0, 2.0, 1.0])])
    # the third: residuals −3, −1, 1, 3 with variance 5, over 1.25
    torch.testing.assert_close(explained_variance(value, target), torch.tensor([1.0, 0.0, -3.0]))


def test_a_target_by_hand_and_what_follows_an_end_may_be_anything():
    reward, discount = torch.tensor([1.0, 2.0]), torch.tensor([0.0, 0.5])
    value = torch.tensor([float("nan"), 8.0])
    assert discounted(discount, value).tolist() == [0.0, 4.0]
    assert td_target(reward, discount, value).tolist() == [1.0, 6.0]
