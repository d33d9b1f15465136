"""Losses, reduced over the batch to one number a member: (P, B) to (P,).

Summing the members gives each its own gradient in one backward pass (contract 5).
"""

from __future__ import annotations

import torch
from torch import Tensor


def ppo_policy_loss(
    log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip_coef: Tensor
) -> Tensor:
    """Clipped surrogate, ``−E[min(ρA, clip(ρ, 1−ε, 1+ε)A)]`` (Schulman et al. 2017, eq. 7).

    Args:
        log_prob, old_log_prob, advantage: (P, B).
        clip_coef: (P,), ε.

    Returns:
        (P,).
    """
    ratio = torch.exp(log_prob - old_log_prob)
    eps = clip_coef[:, None]
    clipped = torch.clamp(ratio, 1.0 - eps, 1.0 + eps)
    return -torch.minimum(ratio * advantage, clipped * advantage).mean(1)


def value_loss(
    value: Tensor, target: Tensor, old_value: Tensor | None = None, clip: Tensor | None = None
) -> Tensor:
    """Half the mean squared error, optionally with PPO's value clipping.

    With ``clip`` (P,) the error is the larger of that of the value and that of the value
    clipped to ``old_value ± clip`` (the original PPO code; Engstrom et al. 2020, sec. 3).

    Args:
        value, target, old_value: (P, B).

    Returns:
        (P,).
    """
    error = (value - target).square()
    if old_value is not None and clip is not None:
        bound = clip[:, None]
        step = torch.minimum(torch.maximum(value - old_value, -bound), bound)
        error = torch.maximum(error, (old_value + step - target).square())
    return 0.5 * error.mean(1)


def approximate_kl(log_prob: Tensor, old_log_prob: Tensor) -> Tensor:
    """``E[(ρ − 1) − log ρ]``, the low-variance estimator k3 of KL(old‖new); (P, B) to (P,).

    Schulman 2020, "Approximating KL divergence".
    """
    log_ratio = log_prob - old_log_prob
    return (torch.expm1(log_ratio) - log_ratio).mean(1)
