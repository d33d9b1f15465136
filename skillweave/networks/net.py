"""A whole network: encoders, hidden layers, recurrent layer, head; parameters are arguments."""

from __future__ import annotations

import torch
from torch import Tensor

from skillweave._internal.messages import suggest
from skillweave.errors import DeclarationError
from skillweave.networks.config import Network
from skillweave.networks.encoders import Encoder, ImageEncoder, Inputs, make_encoder, part, under
from skillweave.networks.stacked import (
    Views,
    mlp,
    mlp_init_,
    mlp_shapes,
    orthogonal_,
    rnn_gates,
    rnn_init_,
    rnn_memory_size,
    rnn_sequence,
    rnn_shapes,
    rnn_step,
)
from skillweave.ops.device import INT, Constant
from skillweave.spaces import ObsCodec


class Net:
    """A network of one architecture on one observation space.

    Args:
        name: the prefix of its parameters' names.
        obs: the codec of the observation space.
        network: its architecture.
        outputs: width of the head; None: no head, the last hidden layer is the output.
        extra: width of the input beside the observation (a critic's action).
    """

    def __init__(
        self, name: str, obs: ObsCodec, network: Network, outputs: int | None, extra: int = 0
    ) -> None:
        self.name = name
        self.network = network
        self.encoders: dict[str, Encoder] = {}
        self._vector = network.encoder is None and obs.size > 0
        if network.encoder is not None:
            self.encoders[f"{name}.encoder"] = make_encoder(network.encoder, obs)
        else:
            for i in range(len(obs.images)):
                image = ImageEncoder(obs, i, network.cnn, network.activation)
                self.encoders[f"{name}.cnn{i}"] = image
        places = seen_places(network, obs)
        self._sees = None if network.sees is None else Constant(torch.tensor(places, **INT))
        self.features = len(places) if self._vector else 0
        """The first column of the encoders' features in the input of the first layer."""
        width = self.features + extra
        width += sum(e.size for e in self.encoders.values())
        self.shapes: dict[str, tuple[int, ...]] = {}
        for prefix, encoder in self.encoders.items():
            self.shapes |= under(prefix, encoder.shapes)
        depth = len(network.hidden)
        self.head = f"{name}.{depth}" if network.rnn is None else f"{name}.head"
        """Prefix of the head's parameters."""
        self.memory_size = 0 if network.rnn is None else rnn_memory_size(network.rnn)
        """M, the width of the recurrent state; 0: the network has none."""
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

    def init_(self, views: Views, head_gain: float, generators: list[torch.Generator]) -> None:
        """Draw fresh parameters, in place.

        Args:
            views: views of its parameters, each (P, *shape).
            head_gain: gain of the head's weights; near 0: all initial outputs are nearly equal.
            generators: one for each of P members.
        """
        for prefix, encoder in self.encoders.items():
            encoder.init_(part(views, prefix), generators)
        mlp_init_(views, self.name, self.network, head_gain, generators)
        if self.network.rnn is not None:
            rnn_init_(views, f"{self.name}.rnn", generators)
            orthogonal_(views[f"{self.head}.weight"], head_gain, generators)
            views[f"{self.head}.bias"].zero_()

    def __call__(self, views: Views, inputs: Inputs, extra: Tensor | None = None) -> Tensor:
        """Map inputs (P, B, …) to (P, B, out), for networks without a recurrent layer."""
        return mlp(views, self.name, self.network, self._joined(views, inputs, extra))

    def step(self, views: Views, inputs: Inputs, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Run a recurrent network for one step.

        Args:
            views: views of its parameters, each (P, *shape).
            inputs: (P, B, …) each.
            memory: recurrent state (P, B, M).

        Returns:
            The output (P, B, out) and the recurrent state after it (P, B, M).
        """
        rnn = self.network.rnn
        name = f"{self.name}.rnn"
        assert rnn is not None
        gates = rnn_gates(views, name, self(views, inputs))
        memory = rnn_step(views, name, rnn, gates, memory)
        return self._head(views, memory[..., : rnn.size]), memory

    def sequence(
        self, views: Views, inputs: Inputs, memory: Tensor, starts: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Run a recurrent network for T steps.

        Args:
            views: views of its parameters, each (P, *shape).
            inputs: (P, T, B, …) each.
            memory: recurrent state (P, B, M) before the first step.
            starts: (P, T, B) bool, True where an episode begins.

        Returns:
            Outputs (P, T, B, out) and the recurrent state after each step (P, T, B, M).
        """
        rnn = self.network.rnn
        steps = starts.shape[1:]
        assert rnn is not None
        x = self(views, {k: v.flatten(1, 2) for k, v in inputs.items()}).unflatten(1, steps)
        after = rnn_sequence(views, f"{self.name}.rnn", rnn, x, memory, starts)
        out = self._head(views, after[..., : rnn.size].flatten(1, 2))
        return out.unflatten(1, steps), after

    def _head(self, views: Views, x: Tensor) -> Tensor:
        bias, weight = views[f"{self.head}.bias"], views[f"{self.head}.weight"]
        return torch.baddbmm(bias, x, weight)

    def _seen(self, vector: Tensor) -> Tensor:
        """Select the numbers (P, B, O) that this network sees."""
        return (
            vector if self._sees is None else vector.index_select(-1, self._sees.on(vector.device))
        )

    def _joined(self, views: Views, inputs: Inputs, extra: Tensor | None) -> Tensor:
        """Join the vector, the encoders' outputs and extra inputs, for the hidden layers."""
        parts = [self._seen(inputs["vector"])] if self._vector else []
        if self.encoders:
            parts += [e(part(views, prefix), inputs) for prefix, e in self.encoders.items()]
        if extra is not None:
            parts.append(extra)
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)


def seen_places(network: Network, obs: ObsCodec) -> tuple[int, ...]:
    """Return the places that a network sees in the flat vector of observations, in its order.

    Raises:
        DeclarationError: the observation has no such number or part, or one is named twice.
    """
    if network.sees is None:
        return tuple(range(obs.size))
    places = [i for x in network.sees for i in ([x] if isinstance(x, int) else _part(x, obs))]
    if max(places) >= obs.size:
        numbers = f"has {obs.size} (0 to {obs.size - 1})"
        raise DeclarationError(
            f"Network.sees names the number {max(places)} of an observation, but it "
            + (numbers if obs.size else "has no number beside its images")
        )
    if len(set(places)) < len(places):
        raise DeclarationError(f"Network.sees is {network.sees}, which names a number twice")
    return tuple(places)


def _part(key: str, obs: ObsCodec) -> list[int]:
    """Return the places of the numbers of a part."""
    places: list[int] = []
    images = start = 0
    for leaf in obs.leaves:
        inside = leaf.name == key or leaf.name.startswith(f"{key}.")
        if leaf.image is not None:
            images += inside
            continue
        places += range(start, start + leaf.size) if inside else ()
        start += leaf.size
    if images and not places:
        raise DeclarationError(
            f"Network.sees names {key!r}, an image, and images are always seen: leave it out"
        )
    if not places:
        known = [leaf.name for leaf in obs.leaves if leaf.name]
        end = suggest(key, known) or "; it has no parts"
        raise DeclarationError(
            f"Network.sees names {key!r}, a part of the observation that does not exist{end}"
        )
    return places
