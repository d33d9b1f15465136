"""Architectures as data; this module does not import torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
