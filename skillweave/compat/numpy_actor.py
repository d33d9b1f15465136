"""Networks that act on few observations at a time, with NumPy in place of torch.

MLPs are copied into NumPy. Every other network acts in torch, by the same interface.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import ActingParams, Algorithm
from skillweave.networks.config import Network
from skillweave.networks.net import Net
from skillweave.networks.stacked import Views
from skillweave.spaces import to_tensor
from skillweave.types import Array

Sampled = tuple[Array, Array, Array, Array]


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
        output: Array = x @ weight
        output += bias
        return output


class NumpyActor:
    """The networks of a state's first member, as they are now: make a new one after learning.

    Not for networks with memory.
    """

    def __init__(self, algorithm: Algorithm, state: Any) -> None:
        self.algorithm = algorithm
        self.state = state
        self._space: Any = algorithm.observation_space
        self._one_hot = not np.issubdtype(self._space.dtype, np.floating)
        family = algorithm.parameter_groups()[0]
        self._all = dict(family.nets)
        self._views = family.layout.views(state.params[:1])
        self._nets = {
            field: NumpyMLP(self._views, net.name, net.network)
            for field, net in family.nets
            if isinstance(net, Net) and not net.encoders and NumpyMLP.fits(net.network)
        }
        if algorithm.normalize_obs or hasattr(self._space, "spaces"):
            self._nets = {}

    def rows(self, obs: Any) -> Array:
        """Return one observation or a batch as (B, *shape), with the dtype of the space."""
        return np.asarray(obs, self._space.dtype).reshape(-1, *self._space.shape)

    def output(self, rows: Array, field: str = "network") -> Array:
        """Return the output of a network's head, (B, out); ``field`` is its field of the config."""
        if field in self._nets:
            return self._nets[field](self._vectors(rows) if self._one_hot else rows)
        with torch.inference_mode():
            actor = ActingParams({}, *self.algorithm.scaling(self.state))
            inputs = self.algorithm.inputs(actor, to_tensor(rows)[None])
            output: Array = self._all[field](self._views, inputs)[0].numpy()
        return output

    def _vectors(self, rows: Array) -> Array:
        vector, _ = self.algorithm.obs.split(to_tensor(rows))
        array: Array = vector.numpy()
        return array


class NumpyPPOActor(NumpyActor):
    """The actor and the critic of PPO."""

    def __init__(self, algorithm: Any, state: Any) -> None:
        super().__init__(algorithm, state)
        self._scale = np.float32(state.return_scale[0, 0])
        self._mean = np.float32(state.return_mean[0, 0])
        self._log_std = self._views.get("actor.log_std")
        self._choices = algorithm.head.discrete and not algorithm.codec.multi

    def sample(self, rows: Array, rng: np.random.Generator) -> Sampled:
        """Return actions (B, …) in policy units; log-probabilities, entropies, values (B,)."""
        dist_params = self.output(rows)
        value = self.output(rows, "critic")[:, 0]
        value = value * self._scale + self._mean
        if not self._choices:
            return *self._drawn(dist_params, rng), value
        shifted = dist_params - dist_params.max(-1, keepdims=True)
        weight = np.exp(shifted)
        running = weight.cumsum(-1)
        total = running[:, -1:]
        action = (running <= rng.random((len(rows), 1), np.float32) * total).sum(-1)
        np.minimum(
            action, dist_params.shape[-1] - 1, out=action
        )  # where rounding led past the last
        log_p = shifted - np.log(total)
        entropy = -(weight * log_p).sum(-1) / total[:, 0]
        return action, log_p[np.arange(len(rows)), action], entropy, value

    def _drawn(self, dist_params: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return actions, log-probabilities and entropies by torch, for all other action spaces."""
        outputs = torch.from_numpy(dist_params)
        head = self.algorithm.head
        log_std = None if self._log_std is None else self._log_std[0]
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        noise = head.noise([generator], 1, len(dist_params))[0, 0]
        action = head.act(outputs, log_std, noise)
        log_prob, entropy = head.stats(outputs, log_std, None, action)
        return action.numpy(), log_prob.numpy(), entropy.expand(len(dist_params)).numpy()
