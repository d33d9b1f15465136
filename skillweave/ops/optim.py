"""Optimiser maths on flat parameters: one row of (P, D) per member, settings of shape (P,)."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import torch
from torch import Tensor

from skillweave._internal.shapes import Bool, Float, Int
from skillweave.ops.device import all_false

FEWEST_FUSED = 2048
"""Parameters of a member from which torch's own Adam is faster than single operations."""


State = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Parameters, gradient, mu, nu and count of ``adam_``."""
Betas = tuple[float, float]


def clip_grad_norm_(
    grad: Float[Tensor, "P D"], max_norm: Float[Tensor, " P"]
) -> Float[Tensor, " P"]:
    """Scale each member's gradient down to ``max_norm`` where it is larger.

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
    """Take one Adam step in place (Kingma & Ba 2015, algorithm 1, in its efficient form).

    Args:
        params: (P, D), changed in place.
        grad: (P, D).
        mu: (P, D), mean of gradients; zero at the start.
        nu: (P, D), mean of their squares; zero at the start.
        count: (P,) or (P, …) int64, steps so far: of a member, or of each parameter if some are
            younger than others.
        learning_rate: (P,).
        beta1: decay of ``mu``.
        beta2: decay of ``nu``.
        eps: keeps the division from 0.
        active: (P,) bool; members at False do not change.
    """
    state = (params, grad, mu, nu, count)
    betas = (beta1, beta2)
    if _can_be_fused(state):
        _fused_(state, learning_rate, betas, eps, active)
    else:
        _formula_(state, learning_rate, betas, eps, active)


def _can_be_fused(state: State) -> bool:
    """Return whether torch's fused Adam can be used: it needs one age and contiguous tensors.

    The answer must not depend on the number of members, so a member learns the same alone and among
    others.
    """
    *tensors, count = state
    params = tensors[0]
    if params.device.type != "cpu" or count.ndim != 1 or torch.compiler.is_compiling():
        return False
    large = params.shape[1] >= FEWEST_FUSED
    return large and all(x.stride(1) == 1 for x in tensors)


def _fused_(
    state: State, learning_rate: Tensor, betas: Betas, eps: float, active: Tensor | None
) -> None:
    """Take the step with torch's own operation, which reads and writes everything once."""
    *tensors, count = state
    members = list(range(len(count))) if active is None else active.nonzero()[:, 0].tolist()
    rates = learning_rate.expand(len(count)).tolist()
    by_rate = defaultdict(list)
    for i in members:
        by_rate[rates[i]].append(i)
    count.add_(1 if active is None else active)
    steps = count.to(torch.float32).unbind()
    rows = [x.unbind() for x in tensors]
    fused: Any = torch._fused_adam_
    for rate, same_rate in by_rate.items():
        params, grad, mu, nu, ages = [[x[i] for i in same_rate] for x in (*rows, steps)]
        fused(
            params,
            grad,
            mu,
            nu,
            [],
            ages,
            lr=rate,
            beta1=betas[0],
            beta2=betas[1],
            eps=eps,
            weight_decay=0.0,
            amsgrad=False,
            maximize=False,
        )
    for changed in (state[0], state[2], state[3]):  # else an old graph's gradient would be wrong
        if not changed.is_inference():
            torch.autograd.graph.increment_version(changed)


def _formula_(
    state: State, learning_rate: Tensor, betas: Betas, eps: float, active: Tensor | None
) -> None:
    """Take the step with single operations, where torch's own cannot be used or is slower."""
    params, grad, mu, nu, count = state
    if active is not None and (torch.compiler.is_compiling() or not all_false(~active)):
        before = [x.clone() for x in (params, mu, nu, count)]
        _formula_(state, learning_rate, betas, eps, None)
        for now, old in zip((params, mu, nu, count), before, strict=True):
            stays = ~active.view(-1, *[1] * (now.ndim - 1))
            now.copy_(torch.where(stays, old, now))
        return
    beta1, beta2 = betas
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
    """Divide the learning rate by 1.5 where the KL exceeds 2·target; multiply where under half.

    Schulman et al. 2017, sec. 4 (there for the KL penalty); the factor as in rl_games. All (P,).
    """
    rate = torch.where(kl > 2.0 * target_kl, learning_rate / 1.5, learning_rate)
    rate = torch.where(kl < 0.5 * target_kl, rate * 1.5, rate)
    return rate.clamp(low, high)
