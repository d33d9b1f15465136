"""Losses, reduced over the batch to one number a member: (P, B) to (P,).

Summing the members gives each its own gradient in one backward pass (contract 5).
"""

from __future__ import annotations

import torch
from torch import Tensor

from skillweave.shapes import Float


def ppo_policy_loss(
    log_prob: Float[Tensor, "P B"],
    old_log_prob: Float[Tensor, "P B"],
    advantage: Float[Tensor, "P B"],
    clip_coef: Float[Tensor, " P"],
    weight: Float[Tensor, "P B"] | None = None,
) -> Float[Tensor, " P"]:
    """Clipped surrogate, ``−E[w·min(ρA, clip(ρ, 1−ε, 1+ε)A)]`` (Schulman et al. 2017, eq. 7).

    ρ is the ratio to the policy from which clipping counts. Where another policy acted, w is the
    ratio of the two: the decoupled objective of Hilton, Cobbe & Schulman 2022, sec. 3.

    Args:
        log_prob, old_log_prob, advantage: (P, B).
        clip_coef: (P,), ε.
        weight: (P, B), w; None: 1.

    Returns:
        (P,).
    """
    ratio = torch.exp(log_prob - old_log_prob)
    eps = clip_coef[:, None]
    clipped = torch.clamp(ratio, 1.0 - eps, 1.0 + eps)
    gain = torch.minimum(ratio * advantage, clipped * advantage)
    return -(gain if weight is None else weight * gain).mean(1)


def value_loss(
    value: Float[Tensor, "P B"],
    target: Float[Tensor, "P B"],
    old_value: Float[Tensor, "P B"] | None = None,
    clip: Float[Tensor, " P"] | None = None,
) -> Float[Tensor, " P"]:
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


def approximate_kl(
    log_prob: Float[Tensor, "P B"],
    old_log_prob: Float[Tensor, "P B"],
    weight: Float[Tensor, "P B"] | None = None,
) -> Float[Tensor, " P"]:
    """``E[w·((ρ − 1) − log ρ)]``, the low-variance estimator k3 of KL(old‖new); (P, B) to (P,).

    Schulman 2020, "Approximating KL divergence". ``weight`` as of ``ppo_policy_loss``: samples of
    another policy count as often as the old one would have drawn them.
    """
    log_ratio = log_prob - old_log_prob
    kl = torch.expm1(log_ratio) - log_ratio
    return (kl if weight is None else weight * kl).mean(1)


def td_loss(
    value: Float[Tensor, "*#batch"], target: Float[Tensor, "*#batch"], kind: str
) -> Float[Tensor, "*batch"]:
    """Huber (threshold 1; Mnih et al. 2015) or half squared error of each sample; any shape."""
    if kind == "huber":
        return torch.nn.functional.smooth_l1_loss(value, target, reduction="none")
    return 0.5 * (value - target).square()


def categorical_projection(
    p: Float[Tensor, "P B N"],
    atoms: Float[Tensor, " N"],
    reward: Float[Tensor, "P B"],
    discount: Float[Tensor, "P B"],
) -> Float[Tensor, "P B N"]:
    """The distribution of ``r + discount·Z`` on the atoms of Z (Bellemare et al. 2017, eq. 7).

    Args:
        p: (P, B, N), probabilities of ``atoms`` (N,), which are evenly spaced.
        reward, discount: (P, B).

    Returns:
        (P, B, N).
    """
    low, high, width = atoms[0], atoms[-1], atoms[1] - atoms[0]
    moved = (reward[..., None] + discount[..., None] * atoms).clamp(low, high)
    # Atom j's mass falls on the two atoms next to where it moved: a triangle around each.
    share = (1.0 - (moved[..., None, :] - atoms[:, None]).abs() / width).clamp_min(0.0)
    return (share * p[..., None, :]).sum(-1)
