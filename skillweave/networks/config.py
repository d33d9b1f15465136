"""Architectures as data; this module does not import torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from skillweave.types import SkillweaveError

Activation = Literal["tanh", "relu", "elu", "silu", "gelu"]


@dataclass(frozen=True)
class MLP:
    """A multi-layer perceptron."""

    hidden: tuple[int, ...] = (64, 64)
    """Width of each hidden layer."""
    activation: Activation = "tanh"
    """Nonlinearity after each hidden layer."""
    layer_norm: bool = False
    """Normalise each hidden layer before its nonlinearity."""

    def __post_init__(self) -> None:
        if any(not isinstance(width, int) or width < 1 for width in self.hidden):
            raise SkillweaveError(f"MLP.hidden is {self.hidden}; every width must be at least 1")
        if self.activation not in get_args(Activation):
            known = ", ".join(get_args(Activation))
            raise SkillweaveError(
                f"MLP.activation is {self.activation!r}; it must be one of {known}"
            )
