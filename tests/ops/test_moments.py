"""Means and variances of valid samples by hand."""

import pytest
import torch

from skillweave.ops.moments import (
    explained_variance,
    masked_mean,
    masked_var_mean,
    merge_moments,
    normalize,
)

NAN = float("nan")
X = torch.tensor([[1.0, NAN, 3.0, 8.0], [NAN, NAN, NAN, NAN]])
VALID = torch.tensor([[1, 0, 1, 1], [0, 0, 0, 0]], dtype=torch.bool)


def test_mean_and_variance_of_valid_samples_by_hand():
    assert masked_mean(X, VALID).tolist() == [4.0, 0.0]
    assert masked_mean(torch.tensor([[[1.0, 2.0], [3.0, 6.0]]])).tolist() == [3.0]
    variance, mean = masked_var_mean(X, VALID)
    assert mean.tolist() == [4.0, 0.0]
    assert variance[0].item() == pytest.approx((9 + 1 + 16) / 3)
    assert variance[1].item() == 0.0


def test_valid_samples_are_normalised_as_if_there_were_no_others():
    kept = normalize(X[:1, VALID[0]])
    assert torch.allclose(normalize(X[:1], VALID[:1])[0, VALID[0]], kept[0])


def test_a_deviation_that_is_too_small_is_not_made_one():
    few = torch.tensor([[1.0, 3.0], [0.001, 0.003]])
    found = normalize(few, min_std=0.1)
    torch.testing.assert_close(found, torch.tensor([[-1.0, 1.0], [-0.01, 0.01]]))
    assert torch.equal(found[0], normalize(few)[0])
    valid = torch.tensor([[True, True, False]])
    found = normalize(torch.tensor([[0.001, 0.003, 99.0]]), valid, min_std=0.1)
    torch.testing.assert_close(found[:, :2], torch.tensor([[-0.01, 0.01]]))


def test_the_variance_explained_is_that_of_valid_samples():
    value = torch.tensor([[1.0, 99.0, 2.0, 8.0]])
    kept = VALID[0]
    alone = explained_variance(value[:, kept], X[:1, kept])
    torch.testing.assert_close(explained_variance(value, X[:1], VALID[:1]), alone)


def test_only_valid_rows_are_merged_and_of_none_nothing_changes():
    g = torch.Generator().manual_seed(0)
    mean, var, count = torch.randn(2, 3, generator=g), torch.ones(2, 3), torch.tensor([4.0, 4.0])
    batch = torch.randn(2, 4, 3, generator=g)
    alone = merge_moments(mean[:1], var[:1], count[:1], batch[:1, VALID[0]])
    batch[~VALID] = NAN
    found = merge_moments(mean, var, count, batch, VALID)
    for one, whole, before in zip(alone, found, (mean, var, count), strict=True):
        torch.testing.assert_close(whole[:1], one)
        torch.testing.assert_close(whole[1], before[1], rtol=0, atol=0)
