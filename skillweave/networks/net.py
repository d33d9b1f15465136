"""A whole network: encoders, hidden layers, memory, head; each call is given parameters."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from skillweave.networks.config import Network
from skillweave.networks.encoders import Encoder, ImageEncoder, Inputs, make_encoder, part, under
from skillweave.networks.recurrent import (
    cell,
    memory_size,
    project,
    rnn_init_,
    rnn_shapes,
    sequence,
)
from skillweave.networks.stacked import Views, mlp, mlp_init_, mlp_shapes, orthogonal_
from skillweave.networks.units import Joint, Units, units_of
from skillweave.spaces import ObsCodec


class Net:
    """One architecture on one observation space.

    Args:
        name: the prefix of its parameters' names.
        outputs: width of the head; None: no head, the last hidden layer is the output.
        extra: width of what is given beside the observation (a critic's action).
    """

    def __init__(
        self, name: str, obs: ObsCodec, network: Network, outputs: int | None, extra: int = 0
    ) -> None:
        self.name, self.network = name, network
        self.encoders: dict[str, Encoder] = {}
        self._vector = network.encoder is None and obs.size > 0
        if network.encoder is not None:
            self.encoders[f"{name}.encoder"] = make_encoder(network.encoder, obs)
        else:
            for i in range(len(obs.images)):
                image = ImageEncoder(obs, i, network.cnn, network.activation)
                self.encoders[f"{name}.cnn{i}"] = image
        self._features = obs.size if self._vector else 0  # where the encoders' features begin
        width = self._features + extra
        width += sum(e.size for e in self.encoders.values())
        self.shapes: dict[str, tuple[int, ...]] = {}
        for prefix, encoder in self.encoders.items():
            self.shapes |= under(prefix, encoder.shapes)
        depth = len(network.hidden)
        self.head = f"{name}.{depth}" if network.rnn is None else f"{name}.head"
        """Prefix of the head's parameters."""
        self.memory = 0 if network.rnn is None else memory_size(network.rnn)
        """M, the width of its memory; 0: it has none."""
        reader = self.head if network.rnn is None else f"{name}.rnn"
        weight, bias = ("weight", "bias") if network.rnn is None else ("input", "bias")
        self.readers: tuple[tuple[str, str], ...] = ((f"{reader}.{weight}", f"{reader}.{bias}"),)
        """Weights and biases of what reads the last hidden layer."""
        if network.rnn is None:
            self.shapes |= mlp_shapes(name, width, network, outputs)
            self.width = outputs or (network.hidden[-1] if network.hidden else width)
        else:
            self.shapes |= mlp_shapes(name, width, network, None)
            last = network.hidden[-1] if network.hidden else width
            self.shapes |= rnn_shapes(f"{name}.rnn", last, network.rnn)
            self.shapes[f"{self.head}.weight"] = (network.rnn.size, outputs or 1)
            self.shapes[f"{self.head}.bias"] = (1, outputs or 1)
            self.width = outputs or 1

    def units(self, layer: int) -> list[Units]:
        """The units of a hidden layer, as one group."""
        width, prefix = self.network.hidden[layer], f"{self.name}.{layer}"
        return [units_of(self.shapes, width, prefix, self._readers(layer))]

    def channels(self, layer: int) -> list[Units]:
        """The channels of a convolution, or of a stage, of every image; several groups."""
        found, start = [], self._features
        for prefix, encoder in self.encoders.items():
            if isinstance(encoder, ImageEncoder):
                onward = tuple((name, start) for name in self._readers(-1))
                found += encoder.units(layer, prefix, onward)
            start += encoder.size
        return found

    def joint(self) -> Joint:
        """Where the last hidden layer meets what reads it."""
        depth = len(self.network.hidden)
        cut = len(prefix := f"{self.name}.{depth - 1}.")
        kinds = tuple(k[cut:] for k in self.shapes if k.startswith(prefix))
        return Joint(self.name, depth, self.readers, kinds)

    def _readers(self, layer: int) -> tuple[str, ...]:
        """Weights that read a hidden layer; -1: the inputs."""
        if layer + 1 < len(self.network.hidden):
            return (f"{self.name}.{layer + 1}.weight",)
        return tuple(weight for weight, _ in self.readers)

    def init_(self, views: Views, head_gain: float, generators: list[torch.Generator]) -> None:
        """Fresh parameters in place, one generator a member."""
        for prefix, encoder in self.encoders.items():
            encoder.init_(part(views, prefix), generators)
        mlp_init_(views, self.name, self.network, head_gain, generators)
        if self.network.rnn is not None:
            rnn_init_(views, f"{self.name}.rnn", generators)
            orthogonal_(views[f"{self.head}.weight"], head_gain, generators)
            views[f"{self.head}.bias"].zero_()

    def __call__(self, views: Views, inputs: Inputs, extra: Tensor | None = None) -> Tensor:
        """Inputs (P, B, …) to (P, B, out), for networks without memory."""
        return mlp(views, self.name, self.network, self._joined(views, inputs, extra))

    def step(self, views: Views, inputs: Inputs, memory: Tensor) -> tuple[Tensor, Tensor]:
        """One step with memory (P, B, M): the output (P, B, out) and the memory after it."""
        rnn, name = self.network.rnn, f"{self.name}.rnn"
        assert rnn is not None
        gates = project(views, name, self(views, inputs))
        memory = cell(views, name, rnn, gates, memory)
        return self._head(views, memory[..., : rnn.size]), memory

    def sequence(
        self, views: Views, inputs: Inputs, memory: Tensor, start: Tensor
    ) -> tuple[Tensor, Tensor]:
        """T steps: inputs (P, T, B, …), memory (P, B, M), start (P, T, B) bool.

        Returns:
            Outputs (P, T, B, out) and the memory after each step (P, T, B, M).
        """
        rnn, steps = self.network.rnn, start.shape[1:]
        assert rnn is not None
        x = self(views, {k: v.flatten(1, 2) for k, v in inputs.items()}).unflatten(1, steps)
        after = sequence(views, f"{self.name}.rnn", rnn, x, memory, start)
        out = self._head(views, after[..., : rnn.size].flatten(1, 2))
        return out.unflatten(1, steps), after

    def _head(self, views: Views, x: Tensor) -> Tensor:
        bias, weight = views[f"{self.head}.bias"], views[f"{self.head}.weight"]
        return torch.baddbmm(bias, x, weight)

    def _joined(self, views: Views, inputs: Inputs, extra: Tensor | None) -> Tensor:
        parts = [inputs["vector"]] if self._vector else []
        if self.encoders:
            parts += [e(part(views, prefix), inputs) for prefix, e in self.encoders.items()]
        if extra is not None:
            parts.append(extra)
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)


class QNet:
    """Values of A actions, each of ``atoms`` numbers; perhaps dueling, perhaps with noisy weights.

    Dueling: the last hidden layer is two, one below the state's value and one below the actions'
    advantages; ``Q = V + A − mean A`` (Wang et al. 2016, eq. 9), atom by atom in C51.

    Noisy: parameters are the means of the weights of hidden layers and heads; beside each stands
    a ``…_sigma`` (Fortunato et al. 2018). Without noise it is the network of the means.
    """

    def __init__(
        self,
        obs: ObsCodec,
        network: Network,
        actions: int,
        *,
        atoms: int = 1,
        dueling: bool = False,
        noisy: bool = False,
    ) -> None:
        self.network, self._actions, self._atoms = network, actions, atoms
        self._parts: list[tuple[str, Network, int]] = []  # name, layers, outputs of each stream
        if dueling:
            trunk, last = replace(network, hidden=network.hidden[:-1]), network.hidden[-1:]
            self._trunk = Net("q", obs, trunk, None)
            stream = replace(network, hidden=last)
            self._parts = [("value", stream, atoms), ("advantage", stream, actions * atoms)]
        else:
            self._trunk = Net("q", obs, network, actions * atoms)
        self.shapes, self.encoders = dict(self._trunk.shapes), self._trunk.encoders
        for name, stream, outputs in self._parts:
            self.shapes |= mlp_shapes(name, self._trunk.width, stream, outputs)
        self._noisy = []
        if noisy:
            own = mlp_shapes("q", 1, self._trunk.network, None if dueling else 1)
            for name, stream, outputs in self._parts:
                own |= mlp_shapes(name, 1, stream, outputs)
            self._noisy = [k.removesuffix(".weight") for k in own if k.endswith(".weight")]
        for layer in self._noisy:
            for kind in ("weight", "bias"):
                self.shapes[f"{layer}.{kind}_sigma"] = self.shapes[f"{layer}.{kind}"]
        if dueling:
            self._trunk.readers = tuple((f"{n}.0.weight", f"{n}.0.bias") for n, _, _ in self._parts)
        self._trunk.shapes = self.shapes  # what reads the trunk, and the deviations of its noise
        self.noise_size = sum(sum(self.shapes[f"{k}.weight"]) for k in self._noisy)
        """Random numbers that one draw of the weights' noise needs; 0: they have none."""

    def units(self, layer: int) -> list[Units]:
        """The units of a hidden layer; of the last, when dueling, a group a stream."""
        if not self._parts or layer < len(self._trunk.network.hidden):
            return self._trunk.units(layer)
        return [
            units_of(self.shapes, stream.hidden[0], f"{name}.0", (f"{name}.1.weight",))
            for name, stream, _ in self._parts
        ]

    def channels(self, layer: int) -> list[Units]:
        """The channels of a convolution, or of a stage, of every image; several groups."""
        return self._trunk.channels(layer)

    def joint(self) -> Joint:
        """Where the trunk's last hidden layer meets what reads it."""
        return self._trunk.joint()

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Fresh parameters in place, one generator a member."""
        self._trunk.init_(views, 1.0, generators)
        for name, stream, _ in self._parts:
            mlp_init_(views, name, stream, 1.0, generators)
        for layer in self._noisy:
            # Means uniform in ±1/√in, deviations 0.5/√in (sec. 3.2, factorised).
            bound = 1.0 / math.sqrt(self.shapes[f"{layer}.weight"][0])
            for kind in ("weight", "bias"):
                for member, generator in enumerate(generators):
                    views[f"{layer}.{kind}"][member].uniform_(-bound, bound, generator=generator)
                views[f"{layer}.{kind}_sigma"].fill_(0.5 * bound)

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Inputs (P, B, …) to (P, B, A, atoms): values, or logits of the atoms."""
        x = self._trunk(views, inputs)
        if not self._parts:
            return x.view(*x.shape[:2], self._actions, self._atoms)
        value, advantage = (mlp(views, name, stream, x) for name, stream, _ in self._parts)
        advantage = advantage.view(*x.shape[:2], self._actions, self._atoms)
        return value[..., None, :] + (advantage - advantage.mean(2, keepdim=True))

    def perturbed(self, views: Views, noise: Tensor) -> dict[str, Tensor]:
        """The views with noise (P, K), standard normal: factorised, ``f(x) = sgn(x)·√|x|``."""
        scaled = noise.sign() * noise.abs().sqrt()
        found, at = dict(views), 0
        for layer in self._noisy:
            n_in, n_out = self.shapes[f"{layer}.weight"]
            rows, columns = (
                scaled[:, at : at + n_in, None],
                scaled[:, None, at + n_in :][..., :n_out],
            )
            at += n_in + n_out
            for kind, eps in (("weight", rows * columns), ("bias", columns)):
                mean, sigma = views[f"{layer}.{kind}"], views[f"{layer}.{kind}_sigma"]
                found[f"{layer}.{kind}"] = torch.addcmul(mean, sigma, eps)
        return found
