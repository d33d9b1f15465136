"""Networks that grow and shrink: units and layers are added to named parameters, or removed.

Growth does not change the function (Net2Net, Chen et al. 2016, with zero outgoing weights): new
units are read with weight zero, a new layer computes the identity.

Letters in shapes: R rows, one per network (a member, or a member's critic).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from skillweave.networks.config import Activation
from skillweave.networks.stacked import Views
from skillweave.networks.units import Joint, Units
from skillweave.ops.device import FLOAT

IDENTITY: tuple[Activation, ...] = ("relu", "elu", "silu", "gelu")
"""Activations through which a new layer can compute the identity; through tanh it cannot."""
PAIRED: tuple[Activation, ...] = ("silu", "gelu")
"""For these ``f(x) − f(−x) = x``: the new layer has two units for each of the layer before."""


def fresh(named: Views, units: Units, extra: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Draw parameters of ``extra`` new units, by name: He-normal weights, biases zero.

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
    """Add ``extra`` units with outgoing weights of zero; ``new`` None: zeros, for moments."""
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
    """Keep only the units ``kept`` (R, m)."""
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
    """Return a parameter's new name: the head is the layer after the hidden ones."""
    head = f"{joint.prefix}.{joint.depth}."
    if not name.startswith(head):
        return name
    return f"{joint.prefix}.{joint.depth + by}.{name[len(head) :]}"
