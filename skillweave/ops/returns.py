"""Returns and advantages from transitions that carry a number ``discount``."""

from __future__ import annotations

import torch
from torch import Tensor

from skillweave.shapes import Bool, Float


def gae(
    reward: Float[Tensor, "P T B"],
    discount: Float[Tensor, "P T B"],
    value: Float[Tensor, "P T B"],
    next_value: Float[Tensor, "P T B"],
    last: Bool[Tensor, "P T B"],
    gae_lambda: Float[Tensor, " P"],
) -> Float[Tensor, "P T B"]:
    """Generalised advantage estimates, exact for semi-MDPs and time limits.

    ``δ = r + discount·V(next) − V``; ``A = δ + discount·λ·(1 − last)·A⁺``
    (Schulman et al. 2016, eq. 16, with the discount as data: γ^τ after a call of τ steps).

    Args:
        reward, discount, value, next_value: (P, T, B) float; ``next_value`` is V of the true
            successor and is ignored where ``discount`` is 0.
        last: (P, T, B) bool, the trajectory is cut here.
        gae_lambda: (P,) float.

    Returns:
        Advantages, (P, T, B).
    """
    # Not a product: what a terminal observation is worth may be anything, 0·NaN is NaN.
    future = torch.where(discount == 0.0, 0.0, discount * next_value)
    delta = reward + future - value
    decay = discount * gae_lambda[:, None, None] * (~last)
    advantage = torch.empty_like(delta)
    running = torch.zeros_like(delta[:, 0])
    for t in range(delta.shape[1] - 1, -1, -1):
        running = torch.addcmul(delta[:, t], decay[:, t], running)
        advantage[:, t] = running
    return advantage


def normalise(x: Float[Tensor, "P *rest"], eps: float = 1e-8) -> Float[Tensor, "P *rest"]:
    """Zero mean and unit deviation over all axes but the first; (P, ...) to (P, ...)."""
    dims = tuple(range(1, x.ndim))
    std, mean = torch.std_mean(x, dim=dims, keepdim=True, unbiased=False)
    return (x - mean) / (std + eps)


def explained_variance(
    value: Float[Tensor, "P *rest"], target: Float[Tensor, "P *rest"]
) -> Float[Tensor, " P"]:
    """``1 − Var(target − value) / Var(target)`` per member; (P, ...) to (P,)."""
    dims = tuple(range(1, value.ndim))
    residual = (target - value).var(dim=dims, unbiased=False)
    return 1.0 - residual / target.var(dim=dims, unbiased=False).clamp_min(1e-12)
