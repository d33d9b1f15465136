"""Action distributions as functions of their parameters; the last axis is the action's."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from skillweave._internal.shapes import Bool, Float, Int

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


def mask_logits(
    logits: Float[Tensor, "*batch A"], mask: Bool[Tensor, "*#batch A"] | None
) -> Float[Tensor, "*batch A"]:
    """Set the logits of forbidden actions to the smallest finite number.

    A finite number keeps entropy and gradients finite (Huang & Ontañón 2022).

    Args:
        logits: (..., A).
        mask: (..., A) bool, allowed actions; None: all.

    Returns:
        (..., A).
    """
    if mask is None:
        return logits
    return logits.masked_fill(~mask, torch.finfo(logits.dtype).min)


def with_epsilon(logits: Tensor, mask: Tensor | None, epsilon: Tensor) -> Tensor:
    """Return logits (..., A) of ``(1 − ε)·softmax + ε·uniform`` over actions that ``mask`` allows.

    Args:
        epsilon: ε, of a shape that broadcasts with (..., A).
    """
    allowed = torch.ones_like(logits) if mask is None else mask.to(logits.dtype)
    uniform = allowed / allowed.sum(-1, keepdim=True)
    share = mask_logits(logits, mask).softmax(-1)
    return mask_logits(torch.lerp(share, uniform, epsilon).clamp_min(1e-30).log(), mask)


def categorical_kl(logits: Tensor, other: Tensor) -> Tensor:
    """Compute KL(p ‖ q) of categoricals, their logits masked alike; (..., A) to (...)."""
    log_p = logits.log_softmax(-1)
    log_q = other.log_softmax(-1).clamp_min(-200.0)
    return (log_p.exp() * (log_p.clamp_min(-200.0) - log_q)).sum(-1)


def normal_kl(mean: Tensor, log_std: Tensor, other: Tensor, other_log_std: Tensor) -> Tensor:
    """Compute KL(p ‖ q) of independent normals, q the other; (..., A) to (...)."""
    variance, other_variance = (2.0 * log_std).exp(), (2.0 * other_log_std).exp()
    moved = (mean - other).square()
    kl = other_log_std - log_std + 0.5 * ((variance + moved) / other_variance - 1.0)
    return kl.sum(-1)


def gumbel(uniform: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Convert uniform noise in [0, 1) to Gumbel noise ``−log(−log u)``; any shape."""
    tiny = torch.finfo(uniform.dtype).tiny
    exponential = (-torch.log(uniform.clamp_min(tiny))).clamp_min(tiny)
    return -torch.log(exponential)


def categorical_sample(
    logits: Float[Tensor, "*#batch A"], noise: Float[Tensor, "*#batch A"]
) -> Int[Tensor, "*batch"]:
    """Sample with the Gumbel-max trick; logits and Gumbel noise (..., A) to (...) int64."""
    return torch.argmax(logits + noise, dim=-1)


def categorical_stats(
    logits: Float[Tensor, "*batch A"], action: Int[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Compute log-probability of ``action`` and entropy; (..., A), (...) int64 to (...), (...)."""
    log_p = torch.log_softmax(logits, dim=-1)
    chosen = log_p.gather(-1, action.unsqueeze(-1)).squeeze(-1)
    return chosen, -(log_p.exp() * log_p).sum(-1)


def normal_stats(
    mean: Float[Tensor, "*batch A"],
    log_std: Float[Tensor, "*#batch A"],
    action: Float[Tensor, "*batch A"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Compute log-density and entropy of independent normals; (..., A) to (...), (...)."""
    z = (action - mean) * torch.exp(-log_std)
    log_prob = (-0.5 * z.square() - log_std - _HALF_LOG_TWO_PI).sum(-1)
    entropy = (log_std + 0.5 + _HALF_LOG_TWO_PI).expand_as(mean).sum(-1)
    return log_prob, entropy


class _ClampInward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bounds = low, high
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient without the part that leads further out of the bounds."""
        (x,) = ctx.saved_tensors
        (low, high) = ctx.bounds
        # A gradient step moves against the gradient.
        outward = ((x < low) & (grad > 0.0)) | ((x > high) & (grad < 0.0))
        return grad.masked_fill(outward, 0.0), None, None


def clamp_inward(x: Float[Tensor, "*shape"], low: float, high: float) -> Float[Tensor, "*shape"]:
    """Clamp ``x`` to [low, high], with a gradient that leads back from outside; any shape.

    A clamp has no gradient outside its bounds, so a number there would stay forever. Here only the
    part that leads further out is zero ("zeroing gradients", Hausknecht & Stone 2016, sec. 5).
    """
    clamped: Tensor = _ClampInward.apply(x, low, high)  # type: ignore[no-untyped-call]
    return clamped


def tanh_log_det(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Compute ``log(1 − tanh²(x))``, the log-derivative of tanh, without cancellation; any shape.

    ``2·(log 2 − x − softplus(−2x))``, as in the SAC authors' code (Haarnoja et al. 2018, app. C).
    """
    return 2.0 * (math.log(2.0) - x - torch.nn.functional.softplus(-2.0 * x))


def masked_log_probs(logits: Tensor, mask: Tensor | None) -> Tensor:
    """Compute log-probabilities of discrete actions; logits and mask (..., A) to (..., A).

    For forbidden actions, the exp of the number is 0, but its products are finite.
    """
    return mask_logits(logits, mask).log_softmax(-1).clamp_min(-200.0)


def squashed_sample(mean: Tensor, log_std: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions ``tanh(mean + std·z)`` and log-density (Haarnoja et al. 2018, app. C).

    Args:
        mean, log_std, z: (..., A), z standard normal.

    Returns:
        (..., A) in (−1, 1), and (...).
    """
    u = torch.addcmul(mean, log_std.exp(), z)
    log_prob = -0.5 * z.square() - log_std - _HALF_LOG_TWO_PI - tanh_log_det(u)
    return u.tanh(), log_prob.sum(-1)


def squashed_entropy(mean: Tensor, log_std: Tensor) -> Tensor:
    """Approximate the entropy of ``tanh`` of normals: (..., A) to (...).

    The entropy of the normals plus ``log(1 − tanh²)`` at their means. The exact term is its
    expectation, which has no closed form.
    """
    return (log_std + 0.5 + _HALF_LOG_TWO_PI + tanh_log_det(mean)).sum(-1)


def smoothed_action(action: Tensor, noise: Tensor, std: Tensor, bound: Tensor) -> Tensor:
    """Add clipped noise to an action in [−1, 1]: target policy smoothing (TD3, eq. 14).

    Args:
        action, noise: (P, B, A), noise standard normal.
        std, bound: (P, 1, 1), the deviation of the noise, and its largest size.
    """
    moved = (noise * std).clamp(-bound, bound)
    return (action + moved).clamp(-1.0, 1.0)
