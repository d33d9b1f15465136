"""Optimiser maths on flat parameters: one row of (P, D) per member, settings of shape (P,)."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

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
    if _can_be_fused(params, grad, mu, nu, count):
        chosen = list(range(len(params))) if active is None else active.nonzero()[:, 0].tolist()
        count.add_(1 if active is None else active)
        _fused_(chosen, params, grad, mu, nu, count, learning_rate, beta1, beta2, eps)
    else:
        _formula_(params, grad, mu, nu, count, learning_rate, beta1, beta2, eps, active)


def _can_be_fused(params: Tensor, grad: Tensor, mu: Tensor, nu: Tensor, count: Tensor) -> bool:
    """Torch's operation wants one age for a tensor, and (unsaid) that it lies in one piece."""
    if params.device.type != "cpu" or count.ndim != 1 or torch.compiler.is_compiling():
        return False
    return all(x[0].is_contiguous() for x in (params, grad, mu, nu))


def _fused_(
    members: list[int],
    params: Tensor,
    grad: Tensor,
    mu: Tensor,
    nu: Tensor,
    count: Tensor,
    learning_rate: Tensor,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """The step of some members, ``count`` being counted: torch reads and writes all once.

    Each member by itself, so that it is the same alone and among others.
    """
    rates, together = learning_rate.tolist(), defaultdict(list)
    for i in members:
        together[rates[i]].append(i)
    steps = count.to(torch.float32).unbind()
    rows = [x.unbind() for x in (params, grad, mu, nu)]
    fused: Any = torch._fused_adam_
    for rate, those in together.items():
        own = [[x[i] for i in those] for x in (*rows, steps)]
        fused(
            *own[:4], [], own[4], lr=rate, beta1=beta1, beta2=beta2, weight_decay=0.0, eps=eps,
            amsgrad=False, maximize=False,
        )  # fmt: skip


def _formula_(
    params: Tensor,
    grad: Tensor,
    mu: Tensor,
    nu: Tensor,
    count: Tensor,
    learning_rate: Tensor,
    beta1: float,
    beta2: float,
    eps: float,
    active: Tensor | None,
) -> None:
    """The same where torch has no such operation, or each parameter has an age of its own."""
    if active is not None and not (active.device.type == "cpu" and bool(active.all())):
        before = [x.clone() for x in (params, mu, nu, count)]
        _formula_(params, grad, mu, nu, count, learning_rate, beta1, beta2, eps, None)
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
