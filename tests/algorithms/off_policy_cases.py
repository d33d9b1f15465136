"""Critics by hand, for algorithms that learn off-policy."""

from __future__ import annotations

import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.sac import SACAlgorithm

P, B = 2, 6


def generators() -> list[torch.Generator]:
    return [Seeds(9 + m).torch() for m in range(P)]


def line(views, prefix: str, m: int, x: torch.Tensor) -> torch.Tensor:
    return x @ views[f"{prefix}.0.weight"][m] + views[f"{prefix}.0.bias"][m, 0]


def critics(algorithm: SACAlgorithm, flat: torch.Tensor, m: int, x: torch.Tensor) -> torch.Tensor:
    """Both critics of a member, (2, B, out)."""
    views = algorithm.critics.layout.views(flat[m])
    return torch.stack([line(views, "critic", k, x) for k in range(2)])
