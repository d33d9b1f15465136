"""Losses, reduced over the batch to one number per member: (P, B) to (P,).

Summing the members gives each its own gradient in one backward pass (contract 5).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from skillweave._internal.shapes import Float
from skillweave.ops.distributions import mask_logits
from skillweave.ops.moments import masked_mean

LARGEST_LOG_RATIO = 20.0
"""The largest log of a ratio of probabilities. Where a policy's deviation is nearly 0, an action of
an older policy can be so unlikely that the ratio is not finite."""


def likelihood_ratio(
    log_prob: Float[Tensor, "P B"], other: Float[Tensor, "P B"]
) -> Float[Tensor, "P B"]:
    """Return the ratio of two policies' probabilities, from log-probabilities (P, B).

    It is at most e²⁰, beyond which it has no gradient.
    """
    return torch.exp((log_prob - other).clamp_max(LARGEST_LOG_RATIO))


def ppo_policy_loss(
    log_prob: Float[Tensor, "P B"],
    old_log_prob: Float[Tensor, "P B"],
    advantage: Float[Tensor, "P B"],
    clip_coef: Float[Tensor, " P"],
    weight: Float[Tensor, "P B"] | None = None,
    valid: Tensor | None = None,
) -> Float[Tensor, " P"]:
    """Compute PPO's clipped surrogate, ``−E[w·min(ρA, clip(ρ, 1−ε, 1+ε)A)]``.

    Schulman et al. 2017, eq. 7. ρ is the ratio to the policy that clipping refers to. Where another
    policy acted, w is the ratio of these two: the decoupled objective of Hilton, Cobbe & Schulman
    2022, sec. 3.

    Args:
        log_prob, old_log_prob, advantage: (P, B).
        clip_coef: (P,), ε.
        weight: (P, B), w; None: 1.
        valid: (P, B) bool, samples that count; None: all.

    Returns:
        (P,).
    """
    ratio = likelihood_ratio(log_prob, old_log_prob)
    eps = clip_coef[:, None]
    clipped = torch.clamp(ratio, 1.0 - eps, 1.0 + eps)
    gain = torch.minimum(ratio * advantage, clipped * advantage)
    return -masked_mean(gain if weight is None else weight * gain, valid)


def value_loss(
    value: Float[Tensor, "P B"],
    target: Float[Tensor, "P B"],
    old_value: Float[Tensor, "P B"] | None = None,
    clip: Float[Tensor, " P"] | None = None,
    valid: Tensor | None = None,
) -> Float[Tensor, " P"]:
    """Compute half the mean squared error, optionally with PPO's value clipping.

    With ``clip`` (P,) the error is the larger of two: the value's, and the error of the value
    clipped to ``old_value ± clip`` (the original PPO code; Engstrom et al. 2020, sec. 3).

    Args:
        value, target, old_value: (P, B).
        valid: (P, B) bool, samples that count; None: all.

    Returns:
        (P,).
    """
    error = (value - target).square()
    if old_value is not None and clip is not None:
        bound = clip[:, None]
        step = torch.minimum(torch.maximum(value - old_value, -bound), bound)
        error = torch.maximum(error, (old_value + step - target).square())
    return 0.5 * masked_mean(error, valid)


def approximate_kl(
    log_prob: Float[Tensor, "P B"],
    old_log_prob: Float[Tensor, "P B"],
    weight: Float[Tensor, "P B"] | None = None,
    valid: Tensor | None = None,
) -> Float[Tensor, " P"]:
    """Estimate KL(old‖new) as ``E[w·((ρ − 1) − log ρ)]``, k3 of low variance; (P, B) to (P,).

    Schulman 2020, "Approximating KL divergence". ``weight`` and ``valid`` as in
    ``ppo_policy_loss``: samples of another policy count as often as the old one would draw them.
    """
    log_ratio = (log_prob - old_log_prob).clamp_max(LARGEST_LOG_RATIO)
    kl = torch.expm1(log_ratio) - log_ratio
    return masked_mean(kl if weight is None else weight * kl, valid)


def td_loss(
    value: Float[Tensor, "*#batch"], target: Float[Tensor, "*#batch"], kind: str
) -> Float[Tensor, "*batch"]:
    """Compute each sample's Huber (threshold 1; Mnih et al. 2015) or half squared error."""
    if kind == "huber":
        return torch.nn.functional.smooth_l1_loss(value, target, reduction="none")
    return 0.5 * (value - target).square()


def weighted_mean(loss: Tensor, weight: Tensor | None) -> Tensor:
    """Compute the mean over the batch, (P, B) to (P,), weighted by prioritised replay."""
    return loss.mean(1) if weight is None else (loss * weight).mean(1)


def critic_loss(q: Tensor, target: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Compute half the squared error of K critics' values (P, K, B) to one target (P, B).

    Returns:
        Loss (P,), summed over the critics; detached, the error of each sample (P, B) and the mean
        value (P,).
    """
    target = target[:, None]
    loss = weighted_mean(td_loss(q, target, "mse").sum(1), weight)
    error = (q.detach() - target).abs().mean(1)
    return loss, error, q.detach().mean((1, 2))


def expectile_loss(
    value: Float[Tensor, "*batch"], target: Float[Tensor, "*batch"], expectile: float
) -> Float[Tensor, "*batch"]:
    """Compute ``|τ − 1(u < 0)|·u²`` of ``u = target − value`` (Kostrikov et al. 2022, eq. 5).

    At 0.5 it is half the squared error; near 1 the value becomes the largest of its targets.

    Args:
        expectile: τ.
    """
    error = target - value
    return torch.where(error < 0, 1.0 - expectile, expectile) * error.square()


def conservative_cost(
    q: Float[Tensor, "P B A"], action: Tensor, mask: Tensor | None
) -> Float[Tensor, "P B"]:
    """Compute ``log Σₐ exp Q(a) − Q(a_data)`` (Kumar et al. 2020, eq. 4).

    Args:
        action: (P, B) int64, those of the data.
        mask: (P, B, A) bool, actions that count; None: all.
    """
    of_data = q.gather(-1, action[..., None]).squeeze(-1)
    return mask_logits(q, mask).logsumexp(-1) - of_data


def expected_soft_value(log_p: Tensor, q: Tensor, alpha: Tensor) -> Tensor:
    """Compute ``Σₐ π(a)·(Q(a) − α·log π(a))`` of discrete actions (Christodoulou 2019, eq. 10).

    Args:
        log_p, q: (P, B, A); alpha: (P, 1).

    Returns:
        (P, B).
    """
    return (log_p.exp() * (q - alpha[..., None] * log_p)).sum(-1)


def masked_entropy_target(target: float, mask: Tensor | None) -> Tensor | float:
    """Return the target entropy where masks (P, B, A) allow only some of A discrete actions.

    For m allowed actions it is ``target·log m / log A``; returned is the mean over the batch, (P,).
    """
    if mask is None or mask.shape[-1] == 1:
        return target
    share = mask.sum(-1).clamp_min(1).log() / math.log(mask.shape[-1])
    return target * share.mean(1)


def categorical_projection(p: Tensor, atoms: Tensor, reward: Tensor, discount: Tensor) -> Tensor:
    """Project ``r + discount·Z`` on the atoms of Z (Bellemare et al. 2017, eq. 7).

    Args:
        p: (P, B, N), probabilities of ``atoms`` (N,), which are evenly spaced.
        reward, discount: (P, B).

    Returns:
        (P, B, N).
    """
    low = atoms[0]
    high = atoms[-1]
    width = atoms[1] - atoms[0]
    moved = (reward[..., None] + discount[..., None] * atoms).clamp(low, high)
    # Atom j's mass is split between the two atoms next to its new position: a triangle around each.
    share = (1.0 - (moved[..., None, :] - atoms[:, None]).abs() / width).clamp_min(0.0)
    return (share * p[..., None, :]).sum(-1)
