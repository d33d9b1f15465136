"""Where the units of a network lie in its parameters: what growth needs to know, and nobody else.

A unit is a number of a hidden layer, or a channel of a convolution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skillweave.networks.encoders import ImageEncoder
from skillweave.networks.net import Net
from skillweave.networks.qnet import QNet


@dataclass(frozen=True)
class Part:
    """Where a layer's units lie in a parameter: unit u from ``start + u·block`` on of an axis."""

    name: str
    axis: int  # from the end: negative
    start: int = 0
    block: int = 1


@dataclass(frozen=True)
class Units:
    """Units that stand side by side: what computes them, and what reads them."""

    count: int
    own: tuple[Part, ...]
    onward: tuple[Part, ...]


def units_of(
    shapes: Mapping[str, tuple[int, ...]], count: int, layer: str, readers: Sequence[str]
) -> Units:
    """Return the units of a layer of weights (in, out), read by the weights named; noise goes along."""
    names = (f"{name}{sigma}" for name in readers for sigma in ("", "_sigma"))
    return Units(
        count,
        tuple(Part(name, -1) for name in shapes if name.startswith(f"{layer}.")),
        tuple(Part(name, -2) for name in names if name in shapes),
    )


@dataclass(frozen=True)
class Joint:
    """Where a layer can be added or taken away: behind the last hidden layer."""

    prefix: str
    depth: int
    readers: tuple[tuple[str, str], ...]  # weight and bias of what reads it
    kinds: tuple[str, ...]  # parameters of a layer: weight, bias, and perhaps their sigmas


def hidden_units(net: Net | QNet, layer: int) -> list[Units]:
    """Return the units of a hidden layer; of the last of a dueling network, one group per stream."""
    trunk = net.trunk if isinstance(net, QNet) else net
    if layer < len(trunk.network.hidden):
        prefix = f"{trunk.name}.{layer}"
        readers = _readers_of(net, layer)
        return [units_of(net.shapes, trunk.network.hidden[layer], prefix, readers)]
    assert isinstance(net, QNet)
    return [
        units_of(net.shapes, stream.hidden[0], f"{name}.0", (f"{name}.1.weight",))
        for name, stream, _ in net.streams
    ]


def channels_of(net: Net | QNet, layer: int) -> list[Units]:
    """Return the channels of a convolution, or of a stage, of every image; several groups."""
    trunk = net.trunk if isinstance(net, QNet) else net
    found, start = [], trunk.features
    for prefix, encoder in net.encoders.items():
        if isinstance(encoder, ImageEncoder):
            onward = tuple((name, start) for name in _readers_of(net, -1))
            found += _encoder_units(encoder, layer, prefix, onward)
        start += encoder.size
    return found


def joint_of(net: Net | QNet) -> Joint:
    """Where the last hidden layer (of a dueling network, of its trunk) meets what reads it."""
    trunk = net.trunk if isinstance(net, QNet) else net
    depth = len(trunk.network.hidden)
    cut = len(prefix := f"{trunk.name}.{depth - 1}.")
    kinds = tuple(k[cut:] for k in net.shapes if k.startswith(prefix))
    return Joint(trunk.name, depth, _readers(net), kinds)


def _readers(net: Net | QNet) -> tuple[tuple[str, str], ...]:
    """Weights and biases of what reads the last hidden layer."""
    if isinstance(net, QNet):
        streams = tuple((f"{name}.0.weight", f"{name}.0.bias") for name, _, _ in net.streams)
        return streams or _readers(net.trunk)
    if net.network.rnn is not None:
        return ((f"{net.name}.rnn.input", f"{net.name}.rnn.bias"),)
    return ((f"{net.head}.weight", f"{net.head}.bias"),)


def _readers_of(net: Net | QNet, layer: int) -> tuple[str, ...]:
    """Weights that read a hidden layer; -1: the inputs."""
    trunk = net.trunk if isinstance(net, QNet) else net
    if layer + 1 < len(trunk.network.hidden):
        return (f"{trunk.name}.{layer + 1}.weight",)
    return tuple(weight for weight, _ in _readers(net))


def _encoder_units(
    encoder: ImageEncoder, layer: int, prefix: str, onward: Sequence[tuple[str, int]]
) -> list[Units]:
    """Return the channels of a convolution or of a stage, in groups that have filters of their own.

    Args:
        prefix: of the encoder's parameters, in the network.
        onward: weights that read the features, and where those begin in them.
    """
    cnn = encoder.cnn
    count, last = cnn.channels[layer], layer == len(cnn.channels) - 1

    def own(*names: str) -> tuple[Part, ...]:
        filters = tuple(Part(f"{prefix}.{n}.weight", -4) for n in names)
        return (*filters, *(Part(f"{prefix}.{n}.bias", -1) for n in names))

    def read(*names: str) -> tuple[Part, ...]:
        return tuple(Part(f"{prefix}.{n}.weight", -3) for n in names)

    after = tuple(Part(name, -2, start, encoder.size // count) for name, start in onward)
    if cnn.kind == "plain":
        return [Units(count, own(str(layer)), after if last else read(str(layer + 1)))]
    s, after = layer, after if last else read(f"{layer + 1}.in")
    return [  # what runs through the stage, and what lies within each of its blocks
        Units(count, own(f"{s}.in", f"{s}.0.1", f"{s}.1.1"), read(f"{s}.0.0", f"{s}.1.0") + after),
        Units(count, own(f"{s}.0.0"), read(f"{s}.0.1")),
        Units(count, own(f"{s}.1.0"), read(f"{s}.1.1")),
    ]
