"""The MLP of one member in NumPy: for one observation, torch's overhead is most of the cost."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from torch import Tensor

from skillweave.networks.config import Network
from skillweave.networks.stacked import Views
from skillweave.types import Array

_ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": lambda x: np.tanh(x, out=x),
    "relu": lambda x: np.maximum(x, 0.0, out=x),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
}


class NumpyMLP:
    """An MLP made of copies of the layers whose names begin with ``prefix``; views of P = 1."""

    def __init__(self, views: Views, prefix: str, network: Network) -> None:
        def copy(name: str) -> Array | None:
            weights: Tensor | None = views.get(f"{prefix}.{name}")
            return None if weights is None else weights[0].detach().numpy().copy()

        kinds = ("weight", "bias", "norm_weight", "norm_bias")
        layers = ([copy(f"{i}.{kind}") for kind in kinds] for i in itertools.count())
        self._layers = list(itertools.takewhile(lambda layer: layer[0] is not None, layers))
        self._activation = _ACTIVATIONS[network.activation]

    @staticmethod
    def fits(network: Network) -> bool:
        """Return whether this class has the network's activation."""
        return network.activation in _ACTIVATIONS

    def __call__(self, x: Array) -> Array:
        """Map (B, in) float32 to (B, out)."""
        for weight, bias, norm_weight, norm_bias in self._layers[:-1]:
            x = x @ weight
            x += bias
            if norm_weight is not None:
                x = x - x.mean(-1, keepdims=True)
                x = x / np.sqrt(np.square(x).mean(-1, keepdims=True) + 1e-5)
                x = x * norm_weight + norm_bias
            x = self._activation(x)
        weight, bias, *_ = self._layers[-1]
        found: Array = x @ weight
        found += bias
        return found
