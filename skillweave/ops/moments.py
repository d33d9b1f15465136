"""Means and variances of each member, of all samples or of the valid ones, and over time.

``valid`` is True or 1 where a sample counts; None: all count. Without valid samples the mean is 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

CONSTANT = 1e-6
"""A number whose deviation is less, relative to its size if that is above 1, is constant."""

CLIP = 10.0
"""Deviations from the mean at which networks see observations clipped."""


def is_constant(mean: Tensor, var: Tensor) -> Tensor:
    """Return whether numbers with these means and variances were constant but for rounding."""
    return var.sqrt() <= CONSTANT * mean.abs().clamp_min(1.0)


def scale_of(mean: Tensor, var: Tensor, eps: float = 1e-8) -> Tensor:
    """Return the divisor of normalised numbers: their deviation, or 1 where they are constant.

    A deviation of nearly 0 would make the first change of a number a huge one.

    Args:
        mean, var: of each number, of one shape.
        eps: added to the variance.
    """
    return torch.where(is_constant(mean, var), 1.0, (var + eps).sqrt())


def masked_mean(x: Tensor, valid: Tensor | None = None) -> Tensor:
    """Return the mean of the valid samples of each member.

    Args:
        x: (P, ...).
        valid: (P, ...) bool; None: all count.

    Returns:
        (P,); 0 for a member without valid samples.
    """
    if valid is None:
        return x.flatten(1).mean(1)
    total = torch.where(valid, x, 0.0).flatten(1).sum(1)
    return total / valid.flatten(1).sum(1).clamp_min(1)


def masked_var_mean(x: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Compute the biased variance and the mean of each member; (P, ...) to (P,)."""
    if valid is None:
        variance, mean = torch.var_mean(x.flatten(1), dim=1, unbiased=False)
        return variance, mean
    mean = masked_mean(x, valid)
    away = x - mean.view(-1, *[1] * (x.ndim - 1))
    return masked_mean(away.square(), valid), mean


def normalize(
    x: Tensor, valid: Tensor | None = None, eps: float = 1e-8, min_std: float = 0.0
) -> Tensor:
    """Normalise to zero mean and unit deviation over all axes but the first.

    Args:
        x: (P, ...).
        valid: (P, ...) bool, the samples of mean and deviation; None: all.
        eps: added to the deviation.
        min_std: the least divisor: it replaces a smaller deviation.

    Returns:
        (P, ...).
    """
    variance, mean = (m.view(-1, *[1] * (x.ndim - 1)) for m in masked_var_mean(x, valid))
    return (x - mean) / (scale_of(mean, variance, 0.0).clamp_min(min_std) + eps)


def explained_variance(value: Tensor, target: Tensor, valid: Tensor | None = None) -> Tensor:
    """Compute ``1 − Var(target − value) / Var(target)`` of each member; (P, ...) to (P,).

    0 where the target is constant.
    """
    residual, _ = masked_var_mean(target - value, valid)
    whole, mean = masked_var_mean(target, valid)
    return torch.where(is_constant(mean, whole), 0.0, 1.0 - residual / whole)


def merge_moments(
    mean: Tensor, var: Tensor, count: Tensor, batch: Tensor, valid: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Update a running mean and variance with a batch (Chan, Golub & LeVeque 1979, eq. 2.1).

    Args:
        mean, var: (P, O); count: (P,); batch: (P, B, O).
        valid: (P, B) bool, rows that count; None: all.

    Returns:
        The new mean, variance and count.
    """
    n: Tensor | float = float(batch.shape[1])
    if valid is None:
        batch_var, batch_mean = torch.var_mean(batch, dim=1, unbiased=False)
    else:
        counts = valid[..., None]
        n = valid.sum(1).to(count.dtype)
        rows = n.clamp_min(1.0)[:, None]
        batch_mean = torch.where(counts, batch, 0.0).sum(1) / rows
        away = (batch - batch_mean[:, None]).square()
        batch_var = torch.where(counts, away, 0.0).sum(1) / rows
    total = count + n
    new = (n / total.clamp_min(1.0))[:, None]
    old = 1.0 - new
    delta = batch_mean - mean
    return mean + delta * new, var * old + batch_var * new + delta.square() * old * new, total
