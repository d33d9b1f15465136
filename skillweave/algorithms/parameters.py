"""The meaning of a state's tensors, for evolution and files; values of schedules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from skillweave.algorithms.schedules import is_schedule, scheduled, start_rate
from skillweave.networks.stacked import Layout


@dataclass(frozen=True)
class ParameterGroup:
    """Fields of a state (..., D) that hold the same networks, so they change together."""

    layout: Layout  # of their columns
    nets: tuple[tuple[str, Any], ...]
    """The networks in the layout, each with the field of the config that shapes it."""
    weights: tuple[str, ...] = ("params",)
    """The field that learns, then its slow copy if it has one."""
    moments: tuple[str, ...] = ("mu", "nu")
    """The optimiser's moments."""
    count: str = "count"
    """The field with the optimiser's steps: (P,), or (..., D) where parameters differ in age."""


def rate_now(config: Any, rate: Tensor, progress: float) -> Tensor:
    """Return the learning rate (P,) at this share of the budget.

    Args:
        rate: (P,), each member's rate at the start.
    """
    if is_schedule(config.learning_rate):
        return torch.full_like(rate, scheduled(config, 1.0 - progress))
    linear = getattr(config, "learning_rate_schedule", "linear") == "linear"
    return rate * (1.0 - progress) if linear else rate


def epsilon_now(config: Any, progress: float, like: Tensor) -> Tensor | None:
    """Return the share of actions drawn uniformly, (P, 1, 1); None: none is drawn.

    Args:
        like: (P,), gives the number of members and the device.
    """
    first = config.epsilon
    last = config.epsilon_final
    if max(first, last or 0.0) == 0.0:
        return None
    fallen = min(1.0, progress / max(config.epsilon_fraction, 1e-9))
    share = first if last is None else first + fallen * (last - first)
    return torch.full((len(like), 1, 1), share, dtype=torch.float32, device=like.device)


LARGEST = torch.finfo(torch.float32).max


def setting_number(value: float | None) -> float:
    """Return a hyperparameter's number in a state; None (no limit) becomes the largest number.

    Not infinity: a state that is not finite has diverged.
    """
    return LARGEST if value is None else float(value)


def member_setting(config: Any, name: str) -> float:
    """Return the number that a state has for a hyperparameter; of a schedule its first value."""
    return start_rate(config) if name == "learning_rate" else setting_number(getattr(config, name))
