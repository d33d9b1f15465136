"""Optimiser maths on flat parameters: one row of (P, D) per member, settings of shape (P,)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from skillweave.shapes import Bool, Float, Int


def clip_grad_norm_(
    grad: Float[Tensor, "P D"], max_norm: Float[Tensor, " P"]
) -> Float[Tensor, " P"]:
    """Scale each member's gradient to at most a norm.

    Args:
        grad: (P, D), changed in place.
        max_norm: (P,).

    Returns:
        The norms before clipping, (P,).
    """
    norm: Tensor = torch.linalg.vector_norm(grad, dim=1)
    grad.mul_((max_norm / (norm + 1e-6)).clamp_max(1.0)[:, None])
    return norm


def adam_(
    params: Float[Tensor, "P D"],
    grad: Float[Tensor, "P D"],
    mu: Float[Tensor, "P D"],
    nu: Float[Tensor, "P D"],
    count: Int[Tensor, "P *each"],
    learning_rate: Float[Tensor, " P"],
    *,
    beta1: float = 0.9,
    beta2: float = 0.999,
    eps: float = 1e-5,
    active: Bool[Tensor, " P"] | None = None,
) -> None:
    """One Adam step in place (Kingma & Ba 2015, algorithm 1, in its efficient form).

    Args:
        params: (P, D), changed in place.
        grad: (P, D).
        mu: (P, D), mean of gradients; zero at the start.
        nu: (P, D), mean of their squares; zero at the start.
        count: (P,) or (P, …) int64, steps taken so far: a member's, or each parameter's own, where
            some are younger than others.
        learning_rate: (P,).
        beta1: decay of ``mu``.
        beta2: decay of ``nu``.
        eps: keeps the division from 0.
        active: (P,) bool; members at False are left exactly as they are.
    """
    if active is not None and not (active.device.type == "cpu" and bool(active.all())):
        before = [x.clone() for x in (params, mu, nu, count)]
        adam_(params, grad, mu, nu, count, learning_rate, beta1=beta1, beta2=beta2, eps=eps)
        for now, old in zip((params, mu, nu, count), before, strict=True):
            stays = ~active.view(-1, *[1] * (now.ndim - 1))
            now.copy_(torch.where(stays, old, now))
        return
    count.add_(1)
    age = (count[:, None] if count.ndim == 1 else count.flatten(1)).to(params.dtype)
    mu.lerp_(grad, 1.0 - beta1)
    nu.mul_(beta2).addcmul_(grad, grad, value=1.0 - beta2)
    correction1 = -torch.expm1(age * math.log(beta1))  # 1 − β₁ᵏ; (P, 1) or (P, D)
    correction2 = (-torch.expm1(age * math.log(beta2))).sqrt()
    step = learning_rate[:, None] * correction2 / correction1
    # eps is scaled too, so that this equals the algorithm as published.
    denominator = nu.sqrt().add_(eps * correction2)
    params.sub_((step * mu).div_(denominator))


def kl_adapted_rate(
    learning_rate: Float[Tensor, " P"],
    kl: Float[Tensor, " P"],
    target_kl: Float[Tensor, " P"],
    low: float,
    high: float,
) -> Float[Tensor, " P"]:
    """Learning rate divided by 1.5 where the KL is over 2·target, times 1.5 where under half.

    Schulman et al. 2017, sec. 4 (there for the KL penalty); the factor as in rl_games. All (P,).
    """
    rate = torch.where(kl > 2.0 * target_kl, learning_rate / 1.5, learning_rate)
    rate = torch.where(kl < 0.5 * target_kl, rate * 1.5, rate)
    return rate.clamp(low, high)
