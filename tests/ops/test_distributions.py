import math

import pytest
import torch

from skillweave.ops.distributions import (
    categorical_stats,
    gumbel,
    mask_logits,
    tanh_log_det,
)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gumbel_noise_is_finite_at_both_ends_and_rises_with_the_uniform(dtype):
    u = torch.tensor([0.0, 1e-30, 0.3, 0.5, 1.0 - 2.0**-24], dtype=dtype)
    noise = gumbel(u)
    assert torch.isfinite(noise).all()
    assert (noise.diff() >= 0).all()
    assert noise[3].item() == pytest.approx(-math.log(math.log(2.0)))


def test_masked_logits_get_no_gradient_and_the_others_a_finite_one():
    logits = torch.tensor([[5.0, 0.0, 1.0]], requires_grad=True)
    masked = mask_logits(logits, torch.tensor([[False, True, True]]))
    log_prob, entropy = categorical_stats(masked, torch.tensor([1]))
    (log_prob + entropy).sum().backward()
    assert logits.grad[0, 0] == 0.0
    assert torch.isfinite(logits.grad).all()
    assert logits.grad[0, 1:].abs().min() > 0


def test_tanhs_log_derivative_is_exact_where_the_plain_formula_is_not():
    x = torch.linspace(-15.0, 15.0, 301)
    exact = torch.log1p(-x.double().tanh().square())
    torch.testing.assert_close(tanh_log_det(x).double(), exact, rtol=1e-5, atol=2e-6)
    assert torch.isinf(torch.log(1.0 - x.tanh().square())).any()
    far = torch.tensor([-300.0, 300.0], requires_grad=True)
    tanh_log_det(far).sum().backward()
    assert far.grad.tolist() == [2.0, -2.0]  # −2·tanh
