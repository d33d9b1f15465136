"""What evolution and files need to know of a state: what its tensors are."""

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
    """What learns, then its slow copy if there is one."""
    moments: tuple[str, ...] = ("mu", "nu")
    """The optimiser's."""
    count: str = "count"
    """The field with the optimiser's steps: (P,), or (..., D) where parameters differ in age."""


def rate_now(config: Any, rate: Tensor, progress: float) -> Tensor:
    """Return the learning rate (P,) at this share of the budget.

    Args:
        rate: (P,), that of each member at the start.
    """
    if is_schedule(config.learning_rate):
        return torch.full_like(rate, scheduled(config, 1.0 - progress))
    linear = getattr(config, "learning_rate_schedule", "linear") == "linear"
    return rate * (1.0 - progress) if linear else rate


LARGEST = torch.finfo(torch.float32).max


def setting_number(value: float | None) -> float:
    """A hyperparameter as it stands in a state, where None (no limit) is the largest number.

    Not infinity: in a state that is not finite something has diverged.
    """
    return LARGEST if value is None else float(value)


def member_setting(config: Any, name: str) -> float:
    """Return the number that a state has for a hyperparameter; of a schedule its first value."""
    return start_rate(config) if name == "learning_rate" else setting_number(getattr(config, name))
