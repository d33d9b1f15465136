"""What evolution and files need to know of a state: what its tensors are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

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


LARGEST = torch.finfo(torch.float32).max


def setting_number(value: float | None) -> float:
    """A hyperparameter as it stands in a state, where None (no limit) is the largest number.

    Not infinity: in a state that is not finite something has diverged.
    """
    return LARGEST if value is None else float(value)
