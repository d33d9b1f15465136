import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from skillweave.ops.moments import merge_moments
from skillweave.ops.optim import (
    FEWEST_FUSED,
    _formula_,
    adam_,
    clip_grad_norm_,
    kl_adapted_rate,
)


def adam_state(members: int, size: int, dtype: torch.dtype = torch.float32):
    zeros = torch.zeros(members, size, dtype=dtype)
    return zeros, zeros.clone(), torch.zeros(members, dtype=torch.int64)


def test_adam_equals_torchs_for_each_members_learning_rate():
    generator = torch.Generator().manual_seed(0)
    params = torch.randn(3, 5, generator=generator).double()
    rates, scale = torch.tensor([[1e-3, 1e-2, 0.1], [1.0, 1e-4, 1e-6]]).double()
    reference = [p.clone().requires_grad_() for p in params]
    optimisers = [
        torch.optim.Adam([p], lr=float(lr), eps=1e-5)
        for p, lr in zip(reference, rates, strict=True)
    ]
    mu, nu, count = adam_state(3, 5, torch.float64)
    for _ in range(20):
        # tiny gradients too, where the place of eps in the formula shows
        grad = torch.randn(3, 5, generator=generator).double() * scale[:, None]
        for p, g, optimiser in zip(reference, grad, optimisers, strict=True):
            p.grad = g.clone()
            optimiser.step()
        adam_(params, grad, mu, nu, count, rates)
        torch.testing.assert_close(params, torch.stack(reference).detach())
    assert count.tolist() == [20] * 3


def test_adam_leaves_inactive_members_exactly_as_they_are():
    generator = torch.Generator().manual_seed(0)
    params, grad = torch.randn(2, 3, 4, generator=generator)
    everyone = [params, *adam_state(3, 4)]
    adam_(params, grad, *everyone[1:], torch.full((3,), 0.1))  # so that no state is zero
    before, alone = [x.clone() for x in everyone], [x.clone() for x in everyone]
    adam_(alone[0], grad, *alone[1:], torch.full((3,), 0.1))
    active = torch.tensor([True, False, True])
    adam_(params, grad, *everyone[1:], torch.full((3,), 0.1), active=active)
    for now, old, full in zip(everyone, before, alone, strict=True):
        assert torch.equal(now[1], old[1])
        torch.testing.assert_close(now[active], full[active])
        assert not torch.equal(now[active], old[active])


SIZE = FEWEST_FUSED + 5


@pytest.fixture
def fused(monkeypatch):
    """How many members torch's own Adam moved, call by call."""
    calls, own = [], torch._fused_adam_

    def counted(params, *rest, **settings):
        calls.append(len(params))
        return own(params, *rest, **settings)

    monkeypatch.setattr(torch, "_fused_adam_", counted)
    return calls


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("active", [None, [True, False, True, True], [False] * 4])
def test_adam_at_once_equals_the_formula(active, dtype, fused):
    generator = torch.Generator().manual_seed(0)
    chosen = None if active is None else torch.tensor(active)
    scale = torch.tensor([1, 1e-4, 1, 1e3])
    params, rates = torch.randn(4, SIZE, generator=generator), torch.tensor([0.1, 0.1, 1e-3, 0.1])
    fast, plain = [[params.to(dtype), *adam_state(4, SIZE, dtype)] for _ in range(2)]
    fast[3][2] = plain[3][2] = 100  # one is older
    for _ in range(30):
        grad = (torch.randn(4, SIZE, generator=generator) * scale[:, None]).to(dtype)
        adam_(fast[0], grad, *fast[1:], rates, active=chosen)
        _formula_((plain[0], grad, *plain[1:]), rates, (0.9, 0.999), 1e-5, chosen)
    assert sum(fused) == 30 * (4 if active is None else sum(active))
    assert torch.equal(fast[3], plain[3])
    for one, other in zip(fast[:3], plain[:3], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", [37, SIZE])
def test_adam_moves_a_member_the_same_alone_and_among_others(size, fused):
    generator = torch.Generator().manual_seed(0)
    all_of = [torch.randn(5, size, generator=generator), *adam_state(5, size)]
    alone, rates = [x[2:3].clone() for x in all_of], torch.tensor([0.1, 0.2, 0.1, 0.1, 0.3])
    for _ in range(10):
        grad = torch.randn(5, size, generator=generator)
        adam_(alone[0], grad[2:3].clone(), *alone[1:], rates[2:3])
        adam_(all_of[0], grad, *all_of[1:], rates)
    assert sum(fused) == (60 if size == SIZE else 0)
    assert all(torch.equal(x[2:3], own) for x, own in zip(all_of, alone, strict=True))


@pytest.mark.parametrize("which", range(4))
def test_adam_moves_what_does_not_lie_in_one_piece_by_the_formula(which, fused):
    generator = torch.Generator().manual_seed(0)
    grad = torch.randn(2, SIZE, generator=generator)
    expected = [torch.zeros(2, SIZE), grad.clone(), *adam_state(2, SIZE)]
    given = [x.clone() for x in expected]
    wide = torch.zeros(2, 2 * SIZE)
    wide[:, ::2] = given[which]
    given[which] = wide[:, ::2]
    adam_(*expected, torch.full((2,), 0.1))
    assert sum(fused) == 2
    adam_(*given, torch.full((2,), 0.1))
    assert sum(fused) == 2
    for one, other in zip(given, expected, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("size", [5, SIZE])
def test_a_gradient_of_a_loss_from_before_a_step_of_adam_is_refused(size):
    params = torch.ones(1, size)
    factor = torch.ones(1, size, requires_grad=True)
    loss = (params * factor).sum()
    adam_(params, torch.ones(1, size), *adam_state(1, size), torch.tensor([0.1]))
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


@pytest.mark.parametrize("size", [5, SIZE])
def test_adam_of_no_member_does_nothing(size):
    adam_(torch.ones(0, size), torch.ones(0, size), *adam_state(0, size), torch.ones(0))


def test_gradients_are_clipped_for_each_member_by_itself():
    grad = torch.tensor([[3.0, 4.0], [0.3, 0.4], [30.0, 40.0], [0.0, 0.0], [3e5, 4e5]])
    no_limit = torch.finfo(torch.float32).max
    norm = clip_grad_norm_(grad, torch.tensor([1.0, 1.0, 5.0, 1.0, no_limit]))
    torch.testing.assert_close(norm, torch.tensor([5.0, 0.5, 50.0, 0.0, 5e5]))
    expected = torch.tensor([[0.6, 0.8], [0.3, 0.4], [3.0, 4.0], [0.0, 0.0], [3e5, 4e5]])
    torch.testing.assert_close(grad, expected, rtol=1e-5, atol=0)


def test_the_rate_follows_the_kl_and_stays_in_its_range():
    kl = torch.tensor([0.021, 0.019, 0.0051, 0.0049, 1.0, 0.0])
    rate = torch.tensor([3e-3, 3e-3, 3e-3, 3e-3, 1.1e-5, 9e-3])
    got = kl_adapted_rate(rate, kl, torch.full((6,), 0.01), 1e-5, 1e-2)
    assert got.tolist() == pytest.approx([2e-3, 3e-3, 3e-3, 4.5e-3, 1e-5, 1e-2])


@given(st.lists(st.integers(1, 9), min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_merged_moments_are_those_of_all_data_together(sizes, seed):
    rng = np.random.default_rng(seed)
    scale, shift = rng.uniform(0.1, 10, (2, 2, 1, 3))
    batches = [rng.normal(size=(2, n, 3)) * scale + shift for n in sizes]
    mean, var, count = (
        torch.zeros(2, 3).double(),
        torch.ones(2, 3).double(),
        torch.zeros(2).double(),
    )
    for batch in batches:
        mean, var, count = merge_moments(mean, var, count, torch.from_numpy(batch))
    together = np.concatenate(batches, axis=1)
    np.testing.assert_allclose(mean, together.mean(1), rtol=1e-9)
    np.testing.assert_allclose(var, together.var(1), rtol=1e-9, atol=1e-12)
    assert count.tolist() == [sum(sizes)] * 2


def test_parameters_of_several_ages_move_as_each_would_by_itself():
    """New units in an old network: fresh moments, so their steps count from their birth."""
    generator = torch.Generator().manual_seed(0)
    params, rate = torch.zeros(1, 4), torch.tensor([0.1])
    mu, nu, count = adam_state(1, 4)
    count = torch.tensor([[100_000, 0, 100_000, 0]])
    alone = [p.clone() for p in (params[:, ::2], mu[:, ::2], nu[:, ::2])]
    fresh = [p.clone() for p in (params[:, 1::2], mu[:, 1::2], nu[:, 1::2])]
    old, young = torch.tensor([100_000]), torch.tensor([0])
    for _ in range(30):
        grad = torch.randn(1, 4, generator=generator)
        adam_(params, grad, mu, nu, count, rate)
        adam_(alone[0], grad[:, ::2], *alone[1:], old, rate)
        adam_(fresh[0], grad[:, 1::2], *fresh[1:], young, rate)
    torch.testing.assert_close(params[:, ::2], alone[0])
    torch.testing.assert_close(params[:, 1::2], fresh[0])
    assert count.tolist() == [[100_030, 30, 100_030, 30]]
    many = torch.tensor([(1 << 24) - 29])  # in the end beyond what a float can count
    for _ in range(30):
        adam_(params, torch.ones(1, 4), mu, nu, many, rate)
    assert many.tolist() == [(1 << 24) + 1]
