"""PPO that acts on few observations at a time, with NumPy in place of torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.ppo import PPOAlgorithm, State
from skillweave.networks.net import Net
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor

_ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": lambda x: np.tanh(x, out=x),
    "relu": lambda x: np.maximum(x, 0.0, out=x),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
}
_LAYER = ("weight", "bias", "norm_weight", "norm_bias")


class NumpyActor:
    """The networks of AgileRL's PPO (P = 1) in NumPy: make a new one after learning.

    MLPs are copied into NumPy; every other network without memory acts in torch.
    """

    def __init__(self, algorithm: PPOAlgorithm, state: State) -> None:
        self.algorithm = algorithm
        self.scaling = algorithm.scaling(state)
        self.views = algorithm.layout.views(state.params)
        nets = algorithm.actor_net, algorithm.critic_net
        self.layers = {net.name: self._layers(net) for net in nets}
        self.scale = np.float32(state.return_scale[0, 0])
        self.mean = np.float32(state.return_mean[0, 0])

    def _layers(self, net: Net) -> list[list[Any]]:
        """Return copies of the layers of an MLP; none where the network must act in torch."""
        known = net.network.activation in _ACTIVATIONS and not self.algorithm.normalize_obs
        if net.encoders or not known:
            return []

        def copied(name: str) -> Array | None:
            weights = self.views.get(f"{net.name}.{name}")
            return None if weights is None else weights[0].detach().numpy().copy()

        depth = len(net.network.hidden)
        return [[copied(f"{i}.{kind}") for kind in _LAYER] for i in range(depth + 1)]

    def output(self, net: Net, rows: Array) -> Array:
        """Return the output (B, out) of a network's head for observations (B, *shape)."""
        layers = self.layers[net.name]
        if not layers:
            params = ActingParams(self.views, *self.scaling)
            with torch.inference_mode():
                inputs = self.algorithm.inputs(params, to_tensor(rows)[None])
                return net(self.views, inputs)[0].numpy()
        *hidden, last = layers
        x = rows
        if not np.issubdtype(rows.dtype, np.floating):
            x = self.algorithm.obs.split(to_tensor(rows))[0].numpy()
        for weight, bias, norm_weight, norm_bias in hidden:
            x = x @ weight
            x += bias
            if norm_weight is not None:
                x = x - x.mean(-1, keepdims=True)
                x = x / np.sqrt(np.square(x).mean(-1, keepdims=True) + 1e-5)
                x = x * norm_weight + norm_bias
            x = _ACTIVATIONS[net.network.activation](x)
        output: Array = x @ last[0]
        output += last[1]
        return output

    def sample(self, rows: Array, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
        """Return actions (B, …) in policy units; log-probabilities, entropies, values (B,)."""
        algorithm = self.algorithm
        dist_params = self.output(algorithm.actor_net, rows)
        value = self.output(algorithm.critic_net, rows)[:, 0] * self.scale + self.mean
        if not algorithm.codec.discrete or algorithm.codec.multi:
            return *self._drawn(dist_params, rng), value
        shifted = dist_params - dist_params.max(-1, keepdims=True)
        weight = np.exp(shifted)
        running = weight.cumsum(-1)
        total = running[:, -1:]
        action = (running <= rng.random((len(rows), 1), np.float32) * total).sum(-1)
        last = dist_params.shape[-1] - 1
        np.minimum(action, last, out=action)  # where rounding led past the last
        log_p = shifted - np.log(total)
        entropy = -(weight * log_p).sum(-1) / total[:, 0]
        return action, log_p[np.arange(len(rows)), action], entropy, value

    def _drawn(self, dist_params: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return actions, log-probabilities and entropies by torch, for all other action spaces."""
        outputs = torch.from_numpy(dist_params)
        head: Any = self.algorithm.head
        log_std = self.views.get("actor.log_std")
        log_std = None if log_std is None else log_std[0]
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        noise = head.noise([generator], 1, len(dist_params))[0, 0]
        action = head.act(outputs, log_std, noise)
        log_prob, entropy = head.stats(outputs, log_std, None, action)
        return action.numpy(), log_prob.numpy(), entropy.expand(len(dist_params)).numpy()
