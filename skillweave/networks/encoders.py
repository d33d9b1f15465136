"""Encoders of observations for P members at once; a convolution with P groups is a stack of P."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from skillweave._internal.arguments import checked_names
from skillweave._internal.named import Named, known_names
from skillweave.errors import DeclarationError
from skillweave.networks.config import CNN, Activation
from skillweave.networks.own import ModuleEncoder
from skillweave.networks.stacked import ACTIVATIONS, Inputs, Views, orthogonal_
from skillweave.ops.device import FLOAT, Constant
from skillweave.spaces import ObsCodec

CELL_KINDS = 16
"""The most kinds of a cell, 0 to 15: larger numbers count as 15, smaller ones as 0."""
CELL_FEATURES = 64
"""Features of an image of cells."""
ONE_HOT_AT_ONCE = 2**20
"""Approximate numbers in the one-hot rows of one product, when a gradient is computed."""
FEWEST_ONE_HOT_ROWS = 32
"""The least one-hot rows of one product: each product reads and writes the whole gradient."""


class Encoder(Protocol):
    """A custom encoder: a map from observations to features, with its own parameters.

    The function passed to ``register_encoder`` creates it once for an observation space. It holds
    no parameters: they are arguments of each call, under the names in ``shapes``, each with the
    member axis P in front.
    """

    size: int
    """F, the width of the features."""
    shapes: dict[str, tuple[int, ...]]
    """Names and shapes of one member's parameters."""

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Fill fresh parameters in place.

        Args:
            views: views of its parameters, each (P, *shape).
            generators: one for each of P members.
        """
        ...

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Map inputs to features (P, B, F)."""
        ...


_REGISTERED: dict[str, Callable[[ObsCodec], Encoder]] = {}


@checked_names
def register_encoder(name: str, make: Callable[[ObsCodec], Encoder]) -> None:
    """Register a custom encoder for ``Network(encoder=name)``.

    Args:
        name: its name in settings; a later registration replaces an earlier one.
        make: creates the encoder from the codec of an observation space.
    """
    _REGISTERED[name] = make


def make_encoder(name: Any, obs: ObsCodec) -> Encoder:
    """Create a registered encoder, or one of a module of the user, on one observation space.

    Raises:
        DeclarationError: the encoder is not registered, or its function is not loaded.
    """
    if isinstance(name, Named):
        return ModuleEncoder(obs, name)
    if name == "cells" and name not in _REGISTERED:
        return CellsEncoder(obs)
    if name not in _REGISTERED and ":" in name:
        raise DeclarationError(
            f"Network.encoder is {name!r}, a function of your own, and its code is not loaded: "
            "load it by the declaration that has it, hierarchy.load(run), or on the command line "
            f"by --recipe FILE.py (functions that are loaded: {known_names()})"
        )
    if name not in _REGISTERED:
        raise DeclarationError(
            f"Network.encoder is {name!r}, which is not registered: call "
            f"skillweave.algorithms.register_encoder({name!r}, ...) before (registered: "
            f"{', '.join(_REGISTERED) or 'none'})"
        )
    return _REGISTERED[name](obs)


class ImageEncoder:
    """A CNN that encodes one image of an observation."""

    def __init__(self, obs: ObsCodec, index: int, cnn: CNN | None, activation: Activation) -> None:
        self._obs = obs
        self._index = index
        channels, height, width = obs.images[index]
        self.cnn = cnn or _default_cnn(min(height, width))
        self._activation = ACTIVATIONS[activation]
        self.shapes: dict[str, tuple[int, ...]] = {}
        self.sizes: list[tuple[int, int]] = []
        """Height and width after each layer, or stage."""
        if self.cnn.kind == "impala":
            for stage, out in enumerate(self.cnn.channels):
                for part in ("in", "0.0", "0.1", "1.0", "1.1"):
                    self._layer(f"{stage}.{part}", channels if part == "in" else out, out, 3)
                height = (height + 1) // 2
                width = (width + 1) // 2
                channels = out
                self.sizes.append((height, width))
        else:
            layers = zip(self.cnn.channels, self.cnn.kernels, self.cnn.strides, strict=True)
            for i, (out, kernel, stride) in enumerate(layers):
                if min(height, width) < kernel:
                    raise DeclarationError(
                        f"Network.cnn does not fit images of {obs.images[index]} (channels, "
                        f"height, width): layer {i} has a kernel of {kernel} pixels, but only "
                        f"{height} x {width} are left; omit cnn, then CNN.small() or CNN() is "
                        "chosen by size, or use smaller kernels or fewer layers"
                    )
                self._layer(str(i), channels, out, kernel)
                height, width = ((x - kernel) // stride + 1 for x in (height, width))
                channels = out
                self.sizes.append((height, width))
        self.size = channels * height * width

    def _layer(self, name: str, n_in: int, n_out: int, kernel: int) -> None:
        self.shapes |= {f"{name}.weight": (n_out, n_in, kernel, kernel), f"{name}.bias": (n_out,)}

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Draw orthogonal filters, gain √2; set biases to zero."""
        for name, view in views.items():
            if name.endswith("weight"):
                orthogonal_(view, math.sqrt(2.0), generators)
            else:
                view.zero_()

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Map raw pixels (P, B, C, H, W) to features (P, B, F)."""
        image = inputs[f"image.{self._index}"]
        members, batch = image.shape[:2]
        x = self._obs.pixels(image, self._index)
        # Members side by side in the channels: (B, P·C, H, W).
        x = x[0] if members == 1 else x.transpose(0, 1).flatten(1, 2)
        if self.cnn.kind == "impala":
            for stage in range(len(self.cnn.channels)):
                x = _conv(views, f"{stage}.in", x, padding=1)
                x = F.max_pool2d(x, 3, 2, padding=1)
                for block in range(2):
                    y = _conv(views, f"{stage}.{block}.0", self._activation(x.clone()), padding=1)
                    x = x + _conv(views, f"{stage}.{block}.1", self._activation(y), padding=1)
            x = self._activation(x)
        else:
            for i, stride in enumerate(self.cnn.strides):
                x = self._activation(_conv(views, str(i), x, stride=stride))
        return x.reshape(batch, members, -1).transpose(0, 1)


def _default_cnn(side: int) -> CNN:
    """Return the default CNN for images whose shorter side has ``side`` pixels."""
    if side >= 36:
        return CNN()
    small = CNN.small()
    return replace(small, kernels=tuple(min(side, kernel) for kernel in small.kernels))


def _conv(views: Views, name: str, x: Tensor, stride: int = 1, padding: int = 0) -> Tensor:
    weight, bias = views[f"{name}.weight"], views[f"{name}.bias"]
    members = weight.shape[0]
    return F.conv2d(x, weight.flatten(0, 1), bias.flatten(), stride, padding, groups=members)


class CellsEncoder:
    """Learnt vectors for each value of each cell; features are the ReLU of their sum.

    This is a dense layer on the one-hot cells, without the zeros. Where the space limits a value
    to 5, it has six vectors, and larger numbers count as 5. Numbers beside the images are features
    without a change.
    """

    def __init__(self, obs: ObsCodec) -> None:
        if not obs.images:
            raise DeclarationError(
                'Network(encoder="cells") reads images of whole numbers, but the observations have '
                "none"
            )
        self._sizes = [math.prod(shape) for shape in obs.images]
        kinds = [_kinds(obs.highest(i)) for i in range(len(obs.images))]
        self._last = [Constant(counts - 1) for counts in kinds]
        # The row of each value's first kind; its rows in a table with CELL_KINDS for each value.
        self._first = [Constant(counts.cumsum(0) - counts) for counts in kinds]
        self._rows = [_rows_of(counts) for counts in kinds]
        self._vector = obs.size > 0
        self.size = CELL_FEATURES * len(kinds) + obs.size
        self.shapes: dict[str, tuple[int, ...]] = {}
        for i, rows in enumerate(self._rows):
            self.shapes |= {
                f"{i}.weight": (len(rows), CELL_FEATURES),
                f"{i}.bias": (1, CELL_FEATURES),
            }

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Draw rows of an orthogonal table, gain √2; set biases to zero.

        The table is drawn for all CELL_KINDS, so a vector does not depend on the number of kinds.
        """
        for i, (rows, cells) in enumerate(zip(self._rows, self._sizes, strict=True)):
            views[f"{i}.bias"].zero_()
            table = torch.empty(1, cells * CELL_KINDS, CELL_FEATURES, **FLOAT)
            for member, generator in zip(views[f"{i}.weight"], generators, strict=True):
                orthogonal_(table, math.sqrt(2.0), [generator])
                member.copy_(table[0, rows])

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Map images (P, B, …) of whole numbers to features (P, B, F)."""
        features = [self._image(views, i, inputs[f"image.{i}"]) for i in range(len(self._rows))]
        if self._vector:
            features.append(inputs["vector"])
        return torch.cat(features, -1)

    def _image(self, views: Views, i: int, image: Tensor) -> Tensor:
        """Encode one image of whole numbers (cells) by a table of its kinds."""
        cell = image.flatten(2)
        last = self._last[i].on(image.device)
        if cell.dtype != torch.uint8:  # may be below 0
            cell = cell.long().clamp(min=0)
        kind = torch.minimum(cell, last)
        rows = kind + self._first[i].on(image.device)
        return torch.relu(sum_of_rows(rows, views[f"{i}.weight"]) + views[f"{i}.bias"])


def _kinds(highest: Tensor) -> Tensor:
    """Return each value's number of kinds, for its highest numbers (C, H, W), (K,) int64."""
    kinds = np.clip(highest.flatten().numpy(), 0, CELL_KINDS - 1)  # torch clips no uint16
    return torch.from_numpy(kinds.astype(np.int64)) + 1


def _rows_of(kinds: Tensor) -> Tensor:
    """Return the rows of existing kinds in a table with K · CELL_KINDS rows, for K values."""
    exists = torch.arange(CELL_KINDS, device="cpu") < kinds[:, None]
    return exists.flatten().nonzero().flatten()


def sum_of_rows(rows: Tensor, table: Tensor) -> Tensor:
    """Return the sums of rows of a table, one table for each member.

    Args:
        rows: (P, B, K) int64, the indices of the rows to add. On a CPU the gradient is wrong where
            one sum has the same row twice.
        table: (P, R, W).

    Returns:
        (P, B, W).
    """
    if table.device.type == "cpu" and torch.is_grad_enabled():
        apply: Any = _SumOfRows.apply
        sums: Tensor = apply(rows, table)
        return sums
    return _sums(rows, table)


def _sums(rows: Tensor, table: Tensor) -> Tensor:
    """Return each member's sums of rows of its table, see ``sum_of_rows``."""
    members, size = table.shape[:2]
    if members > 1:  # the members' tables are stacked into one
        rows = rows + torch.arange(members, device=rows.device)[:, None, None] * size
    total = F.embedding_bag(rows.flatten(0, 1), table.flatten(0, 1), mode="sum")
    return total.view(members, -1, total.shape[1])


class _SumOfRows(torch.autograd.Function):
    """Sums of rows with a dense gradient: on a CPU faster than torch's, which sorts all rows."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, table: Tensor) -> Tensor:
        """Return the sums."""
        ctx.save_for_backward(rows)
        ctx.shape = table.shape
        return _sums(rows, table)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        """Return the gradient by the table: transposed one-hot rows times the sums' gradient."""
        (rows,) = ctx.saved_tensors
        members, size, _ = ctx.shape
        total = grad.new_zeros(ctx.shape)
        length = max(FEWEST_ONE_HOT_ROWS, ONE_HOT_AT_ONCE // (members * size))
        for index, slope in zip(rows.split(length, 1), grad.split(length, 1), strict=True):
            one_hot = grad.new_zeros(members, index.shape[1], size).scatter_(2, index, 1.0)
            total.baddbmm_(one_hot.mT, slope)
        return None, total


def part(views: Views, prefix: str) -> dict[str, Tensor]:
    """Return the parameters under a prefix, by their names within it."""
    return {k.removeprefix(f"{prefix}."): v for k, v in views.items() if k.startswith(f"{prefix}.")}


def under(prefix: str, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Return the shapes with a prefix before their names."""
    return {f"{prefix}.{k}": v for k, v in shapes.items()}


__all__ = ["Encoder", "ImageEncoder", "Inputs", "make_encoder", "part", "register_encoder", "under"]
