"""The positions of a network's units in its parameters, for growth.

A unit is a number of a hidden layer, or a channel of a convolution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skillweave.networks.encoders import ImageEncoder
from skillweave.networks.net import Net
from skillweave.networks.qnet import QNet


@dataclass(frozen=True)
class UnitRange:
    """The position of a layer's units in a parameter: unit u at ``start + u·block`` of an axis."""

    name: str
    axis: int  # from the end: negative
    start: int = 0
    block: int = 1


@dataclass(frozen=True)
class Units:
    """Units of one layer: the parameters that compute them, and those that read them."""

    count: int
    own: tuple[UnitRange, ...]
    onward: tuple[UnitRange, ...]


def units_of(
    shapes: Mapping[str, tuple[int, ...]], count: int, layer: str, readers: Sequence[str]
) -> Units:
    """Return the units of a layer of weights (in, out) that ``readers`` read, noise included."""
    names = (f"{name}{sigma}" for name in readers for sigma in ("", "_sigma"))
    return Units(
        count,
        tuple(UnitRange(name, -1) for name in shapes if name.startswith(f"{layer}.")),
        tuple(UnitRange(name, -2) for name in names if name in shapes),
    )


@dataclass(frozen=True)
class Joint:
    """The place behind the last hidden layer, where a layer can be added or removed."""

    prefix: str
    depth: int
    readers: tuple[tuple[str, str], ...]  # weight and bias of each layer that reads it
    kinds: tuple[str, ...]  # parameters of a layer: weight, bias, and perhaps their sigmas


def hidden_units(net: Net | QNet, layer: int) -> list[Units]:
    """Return the units of a hidden layer; in a dueling network the last has a group per stream."""
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
    groups: list[Units] = []
    start = trunk.features
    for prefix, encoder in net.encoders.items():
        if isinstance(encoder, ImageEncoder):
            onward = tuple((name, start) for name in _readers_of(net, -1))
            groups += _encoder_units(encoder, layer, prefix, onward)
        start += encoder.size
    return groups


def joint_of(net: Net | QNet) -> Joint:
    """Return the joint between the last hidden layer (of the trunk, if dueling) and its readers."""
    trunk = net.trunk if isinstance(net, QNet) else net
    depth = len(trunk.network.hidden)
    prefix = f"{trunk.name}.{depth - 1}."
    kinds = tuple(k.removeprefix(prefix) for k in net.shapes if k.startswith(prefix))
    return Joint(trunk.name, depth, _readers(net), kinds)


def _readers(net: Net | QNet) -> tuple[tuple[str, str], ...]:
    """Return weights and biases of the layers that read the last hidden layer."""
    if isinstance(net, QNet):
        streams = tuple((f"{name}.0.weight", f"{name}.0.bias") for name, _, _ in net.streams)
        return streams or _readers(net.trunk)
    if net.network.rnn is not None:
        return ((f"{net.name}.rnn.input", f"{net.name}.rnn.bias"),)
    return ((f"{net.head}.weight", f"{net.head}.bias"),)


def _readers_of(net: Net | QNet, layer: int) -> tuple[str, ...]:
    """Return the weights that read a hidden layer; -1: the inputs."""
    trunk = net.trunk if isinstance(net, QNet) else net
    if layer + 1 < len(trunk.network.hidden):
        return (f"{trunk.name}.{layer + 1}.weight",)
    return tuple(weight for weight, _ in _readers(net))


def _encoder_units(
    encoder: ImageEncoder, layer: int, prefix: str, onward: Sequence[tuple[str, int]]
) -> list[Units]:
    """Return the channels of a convolution or of a stage, in groups with separate filters.

    Args:
        prefix: the prefix of the encoder's parameters in the network.
        onward: weights that read the features, and the features' first row in them.
    """
    cnn = encoder.cnn
    count = cnn.channels[layer]
    last = layer == len(cnn.channels) - 1

    def own(*names: str) -> tuple[UnitRange, ...]:
        filters = tuple(UnitRange(f"{prefix}.{n}.weight", -4) for n in names)
        return (*filters, *(UnitRange(f"{prefix}.{n}.bias", -1) for n in names))

    def read(*names: str) -> tuple[UnitRange, ...]:
        return tuple(UnitRange(f"{prefix}.{n}.weight", -3) for n in names)

    after = tuple(UnitRange(name, -2, start, encoder.size // count) for name, start in onward)
    if cnn.kind == "plain":
        return [Units(count, own(str(layer)), after if last else read(str(layer + 1)))]
    stage = layer
    after = after if last else read(f"{layer + 1}.in")
    return [  # the channels through the whole stage, and those within each of its blocks
        Units(
            count,
            own(f"{stage}.in", f"{stage}.0.1", f"{stage}.1.1"),
            read(f"{stage}.0.0", f"{stage}.1.0") + after,
        ),
        Units(count, own(f"{stage}.0.0"), read(f"{stage}.0.1")),
        Units(count, own(f"{stage}.1.0"), read(f"{stage}.1.1")),
    ]
