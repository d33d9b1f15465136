"""Changes of a member's networks, weights and moments included.

A change is drawn for the settings' networks (``network`` and, if it has one, ``critic``);
``rebuilt`` then converts every tensor of the member's state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.named import Named
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.errors import DeclarationError
from skillweave.evolution.config import Mutations
from skillweave.evolution.stacks import Member, copy, even_count, networks_of, spread_count
from skillweave.networks.config import CNN, Activation, Network
from skillweave.networks.encoders import ImageEncoder
from skillweave.networks.stacked import Views
from skillweave.networks.units import Joint, Units, channels_of, hidden_units, joint_of
from skillweave.ops.device import FLOAT

Alter = Callable[[Views, bool], dict[str, Tensor]]
"""A function from parameters by name, and whether they are moments, to changed parameters."""


@dataclass(frozen=True)
class Change:
    """A change of the networks: of units of a layer, or of a whole layer."""

    kind: str  # units, channels, kernel, layer
    layer: int = 0
    by: int = 0  # units or channels; of a layer 1 or −1


def check_architecture(config: AlgorithmConfig, mutations: Mutations, where: str) -> None:
    """Raise a DeclarationError where networks do not support the mutations."""
    if mutations.architecture == 0.0:
        return
    for name, network in networks_of(config).items():
        if isinstance(network.encoder, Named):
            has = (
                f"an encoder of your own ({network.encoder}), whose architecture is its code: set "
                "it to 0"
            )
        elif network.layer_norm:
            has = (
                "layer_norm, with which no unit can be added without changing the function: set it "
                "to 0, or layer_norm=False"
            )
        elif not network.hidden:
            has = "no hidden layers to change: set it to 0, or give it some"
        else:
            continue
        raise DeclarationError(
            f"{where}Mutations.architecture is {mutations.architecture:g}, but {name} has {has}"
        )


def draw_change(member: Member, mutations: Mutations, spaces: Any, rng: Any) -> Change | None:
    """Draw a change within the limits; return None if no change is possible."""
    config = member.config
    network: Network = config.network
    units = [
        Change("units", layer, by)
        for layer, width in enumerate(network.hidden)
        for by in _steps(width, int(rng.choice([8, 16, 32, 64])), mutations.units)
    ]
    cnn = _cnn(member, spaces)
    for layer, count in enumerate(cnn.channels if cnn else ()):
        steps = _steps(count, max(1, count // 4), mutations.channels)
        units += [Change("channels", layer, by) for by in steps]
    if cnn is not None and cnn.kind == "plain":
        units += _kernels(member, cnn, mutations, spaces)
    layers = [Change("layer", by=by) for by in (1, -1) if _fits(config, by, mutations)]
    first, second = (layers, units) if rng.random() < mutations.layer_share else (units, layers)
    options = first or second
    return options[int(rng.integers(len(options)))] if options else None


def _kernels(member: Member, cnn: CNN, mutations: Mutations, spaces: Any) -> list[Change]:
    """Return changes of kernels by a pixel that keep the size of every layer's output."""
    obs = member.algorithm(spaces).obs
    changes = []
    low, high = mutations.kernels
    for layer, kernel in enumerate(cnn.kernels):
        for by in (1, -1):
            if not low <= kernel + by <= high:
                continue
            change = Change("kernel", layer, by)
            other = changed(Network(cnn=cnn), change, cnn, False).cnn
            try:
                sizes = [
                    [ImageEncoder(obs, i, c, "relu").sizes for c in (cnn, other)]
                    for i in range(len(obs.images))
                ]
            except DeclarationError:
                continue  # larger than the remaining image
            if all(old == new for old, new in sizes):
                changes.append(change)
    return changes


def _steps(size: int, by: int, limits: tuple[int, int]) -> list[int]:
    """Return the possible growth and shrinkage of a size within its limits."""
    grown = min(limits[1], size + by) - size
    shrunk = max(limits[0], size - by) - size
    return [step for step, ok in ((grown, grown > 0), (shrunk, shrunk < 0)) if ok]


def _fits(config: AlgorithmConfig, by: int, mutations: Mutations) -> bool:
    """Return whether a mutation can add or remove a layer."""
    network = config.network
    fewest = mutations.layers[0]
    behind = len(network.hidden) - getattr(config, "dueling", False)
    if by < 0:
        return len(network.hidden) > fewest and behind > 1
    if behind < 1 or len(network.hidden) >= mutations.layers[1]:
        return False
    widest = network.hidden[behind - 1] * (1 + (network.activation in PAIRED))
    able = all(n.activation in IDENTITY for n in networks_of(config).values())
    return able and widest <= mutations.units[1]


def _cnn(member: Member, spaces: Any) -> CNN | None:
    """Return the CNN of the member's images, if one architecture encodes them all."""
    (_, net), *_ = member.algorithm(spaces).parameter_groups()[0].nets
    kinds = {e.cnn for e in net.encoders.values() if isinstance(e, ImageEncoder)}
    return kinds.pop() if len(kinds) == 1 else None


def changed(network: Network, change: Change, cnn: CNN | None, dueling: bool) -> Network:
    """Return a member's network after a change; ``cnn`` is its current encoder of images."""
    if change.kind == "channels":
        assert cnn is not None
        new = tuple(c + change.by * (i == change.layer) for i, c in enumerate(cnn.channels))
        return replace(network, cnn=replace(cnn, channels=new))
    if change.kind == "kernel":
        assert cnn is not None
        kernels = tuple(k + change.by * (i == change.layer) for i, k in enumerate(cnn.kernels))
        return replace(network, cnn=replace(cnn, kernels=kernels))
    hidden = list(network.hidden)
    behind = len(hidden) - dueling  # behind the last layer of the trunk
    if change.kind == "units":
        layer = min(change.layer, len(hidden) - 1)
        hidden[layer] = max(1, hidden[layer] + change.by)
    elif change.by > 0:
        hidden.insert(behind, hidden[behind - 1] * (1 + (network.activation in PAIRED)))
    elif behind > 1:
        del hidden[behind - 1]
    return replace(network, hidden=tuple(hidden))


def rebuilt(member: Member, change: Change, spaces: Any, rng: np.random.Generator) -> Member:
    """Return the member after a change: settings, weights and moments."""
    old = member.algorithm(spaces)
    cnn = _cnn(member, spaces)
    dueling = bool(getattr(old.config, "dueling", False))
    networks: dict[str, Any] = {
        name: changed(network, change, cnn, dueling)
        for name, network in networks_of(old.config).items()
    }
    config = replace(old.config, **networks)
    new = make_algorithm(config, *spaces)
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    state = vars(copy(member).state)
    for before, after in zip(old.parameter_groups(), new.parameter_groups(), strict=True):
        state |= _carried(before, after, state, change, generator)
    return replace(member, config=config, state=new.state_type(**state))


def _carried(
    before: ParameterGroup,
    after: ParameterGroup,
    state: dict[str, Tensor],
    change: Change,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Return a parameter group's weights and moments in the layout of the changed network."""
    names = (*before.weights, *before.moments, before.count)
    lead = state[names[0]].shape[:-1]
    # New parameters begin with moments of 0 after 0 steps; the others keep theirs.
    count = spread_count(state[before.count], state[names[0]]).double()  # as moments are: no int
    flat = {**state, before.count: count}
    named = {k: before.layout.views(flat[k].reshape(-1, before.layout.size)) for k in names}
    for _, net in before.nets:
        for part in _parts_of(net, change):
            online = named[before.weights[0]]
            activation = net.network.activation
            alter = _altered(part, change.by, online, activation, generator)
            named = {k: alter(v, k not in before.weights) for k, v in named.items()}
    fields = {k: after.layout.flatten(v).reshape(*lead, -1) for k, v in named.items()}
    return fields | {before.count: even_count(fields[before.count].long())}


def _parts_of(net: Any, change: Change) -> Sequence[Units | Joint | str]:
    """Return the parts of a member's network that a mutation changes: units, layer, filters."""
    if change.kind == "layer":
        joint = joint_of(net)
        return [joint] * (change.by > 0 or joint.depth > 1)
    if change.kind == "kernel":
        return [
            f"{prefix}.{change.layer}.weight"
            for prefix, encoder in net.encoders.items()
            if isinstance(encoder, ImageEncoder)
        ]
    if change.kind == "channels":
        return channels_of(net, change.layer)
    return hidden_units(net, min(change.layer, len(net.network.hidden) - 1))


def _altered(
    part: Units | Joint | str,
    by: int,
    online: Views,
    activation: Activation,
    generator: torch.Generator,
) -> Alter:
    """Return the change of a part, the same for all parameters of a family."""
    if isinstance(part, str):
        return lambda v, moments: with_kernel(v, part, by)
    if isinstance(part, Joint):
        if by > 0:
            return lambda v, moments: deepened(v, part, activation, moments=moments)
        return lambda v, moments: shallower(v, part, moments=moments)
    if by > 0:
        new = fresh(online, part, by, generator)
        return lambda v, moments: widened(v, part, by, None if moments else new)
    units_to_keep = most_read(online, part, max(1, part.count + by))
    return lambda v, moments: narrowed(v, part, units_to_keep)


IDENTITY: tuple[Activation, ...] = ("relu", "elu", "silu", "gelu")
"""Activations through which a new layer can compute the identity; through tanh it cannot."""
PAIRED: tuple[Activation, ...] = ("silu", "gelu")
"""For these ``f(x) − f(−x) = x``: the new layer has two units for each of the layer before."""


def fresh(named: Views, units: Units, extra: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Draw a mutation's ``extra`` new units, by parameter: He-normal weights, biases zero.

    The deviations of noisy weights are the mean of the existing ones.
    """
    parameters = {}
    for part in units.own:
        old = named[part.name]
        shape = list(old.shape)
        shape[part.axis] = extra * part.block
        new = torch.zeros(shape, **FLOAT)
        if part.name.endswith("weight"):
            inputs = shape[-2] if part.axis == -1 else math.prod(shape[-3:])
            new = torch.randn(shape, generator=generator, **FLOAT) * (2.0 / inputs) ** 0.5
        elif part.name.endswith("_sigma"):
            new = new + old.mean()
        parameters[part.name] = new
    return parameters


def widened(named: Views, units: Units, extra: int, new: Views | None) -> dict[str, Tensor]:
    """Add a mutation's ``extra`` units with outgoing weights of zero; ``new`` None: moments."""
    grown = dict(named)
    for part in (*units.own, *units.onward):
        old = grown[part.name]
        shape = list(old.shape)
        shape[part.axis] = extra * part.block
        added = new[part.name] if new is not None and part in units.own else old.new_zeros(shape)
        end = part.start + units.count * part.block
        before, after = old.tensor_split([end], dim=part.axis)
        grown[part.name] = torch.cat([before, added, after], dim=part.axis)
    return grown


def most_read(named: Views, units: Units, count: int) -> Tensor:
    """Return the ``count`` units with the largest outgoing weights, (R, count), in order."""
    total: Tensor | None = None
    for part in units.onward:
        weight = named[part.name].abs().movedim(part.axis, 1)
        span = units.count * part.block
        weight = weight[:, part.start : part.start + span].flatten(2).sum(2)
        each = weight.view(len(weight), units.count, part.block).sum(2)
        total = each if total is None else total + each
    assert total is not None
    return total.topk(count, dim=1).indices.sort(dim=1).values


def narrowed(named: Views, units: Units, units_to_keep: Tensor) -> dict[str, Tensor]:
    """Keep only ``units_to_keep``, (R, m)."""
    cropped = dict(named)
    rows = len(units_to_keep)
    for part in (*units.own, *units.onward):
        old = cropped[part.name]
        end = part.start + units.count * part.block
        inner = (
            part.start
            + units_to_keep[..., None] * part.block
            + torch.arange(part.block, device="cpu")
        )
        before, after = (
            torch.arange(*span, device="cpu")
            for span in ((0, part.start), (end, old.shape[part.axis]))
        )
        index = torch.cat(
            [before.expand(rows, -1), inner.flatten(1), after.expand(rows, -1)], dim=1
        )
        shape = [1] * old.ndim
        shape[0] = rows
        shape[part.axis] = index.shape[1]
        cropped[part.name] = torch.take_along_dim(old, index.view(shape), dim=part.axis)
    return cropped


def with_kernel(named: Views, name: str, by: int) -> dict[str, Tensor]:
    """Add rows and columns of zeros at the end of filters (R, out, in, k, k), or remove some.

    If no layer's output changes its size, larger filters compute the same function.
    """
    return {**named, name: torch.nn.functional.pad(named[name], (0, by, 0, by))}


def deepened(
    named: Views, joint: Joint, activation: Activation, *, moments: bool
) -> dict[str, Tensor]:
    """Add a hidden layer that is the identity; in moments, new entries are zeros."""
    paired = activation in PAIRED
    grown = _renamed(named, joint, 1)
    readers = [tuple(_moved(n, joint, 1) for n in pair) for pair in joint.readers]
    width = grown[readers[0][0]].shape[-2]
    rows = len(grown[readers[0][0]])
    eye = torch.eye(width, **FLOAT).expand(rows, -1, -1)
    weight = torch.cat([eye, -eye], dim=-1) if paired else eye
    bias = torch.full((rows, 1, weight.shape[-1]), float(activation == "elu"), **FLOAT)
    for kind in joint.kinds:
        value = weight if kind == "weight" else bias if kind == "bias" else None
        like = weight if kind.startswith("weight") else bias
        if value is None or moments:
            value = torch.zeros_like(like)
        grown[f"{joint.prefix}.{joint.depth}.{kind}"] = value
    for name, offset in readers:
        for sigma in ("", "_sigma") if f"{name}_sigma" in grown else ("",):
            old = grown[name + sigma]
            if activation == "elu" and not moments and not sigma:
                # elu(x + 1) = x + 1 for any output x of an elu; the reader subtracts the 1.
                grown[offset] = grown[offset] - old.sum(-2, keepdim=True)
            if paired:
                other = torch.zeros_like(old) if moments or sigma else -old
                grown[name + sigma] = torch.cat([old, other], dim=-2)
    return grown


def shallower(named: Views, joint: Joint, *, moments: bool) -> dict[str, Tensor]:
    """Remove the last hidden layer: its readers read the layer before, through its weights.

    As if the layer were linear; moments become zeros, because the readers are new.
    """
    last = f"{joint.prefix}.{joint.depth - 1}"
    weight, bias = named[f"{last}.weight"], named[f"{last}.bias"]
    gone = {f"{last}.{kind}" for kind in joint.kinds}
    rest = {k: v for k, v in named.items() if k not in gone}
    for name, offset in joint.readers:
        read = named[name]
        rest[name] = weight @ read
        rest[offset] = named[offset] + bias @ read
        if f"{name}_sigma" in named:
            sigma = named[f"{name}_sigma"].mean((-2, -1), keepdim=True)
            rest[f"{name}_sigma"] = sigma.expand_as(rest[name])
        if moments:
            for k in (name, offset, f"{name}_sigma", f"{offset}_sigma"):
                if k in rest:
                    rest[k] = torch.zeros_like(rest[k])
    return _renamed(rest, joint, -1)


def _renamed(named: Views, joint: Joint, by: int) -> dict[str, Tensor]:
    return {_moved(k, joint, by): v for k, v in named.items()}


def _moved(name: str, joint: Joint, by: int) -> str:
    """Return a parameter's new name after a mutation: the head follows the hidden layers."""
    head = f"{joint.prefix}.{joint.depth}."
    if not name.startswith(head):
        return name
    return f"{joint.prefix}.{joint.depth + by}.{name[len(head) :]}"
