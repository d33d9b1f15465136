"""The encoder of images whose pixels are kinds, not brightnesses, as MiniGrid's grids of objects.

Stands alone because it implements the ``Encoder`` protocol, as a user's encoder does.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from skillweave.errors import DeclarationError
from skillweave.networks.stacked import Inputs, Views, orthogonal_
from skillweave.ops.device import FLOAT, Constant
from skillweave.spaces import ObsCodec

KINDS = 16
"""The most kinds, 0 to 15: larger numbers count as 15, smaller ones as 0."""
WIDTH = 64
"""Features of each image."""
AT_ONCE = 2**20
"""Approximate numbers in the one-hot rows of one product, when a gradient is computed."""
FEWEST_ROWS = 32
"""The least one-hot rows of one product: each product reads and writes the whole gradient."""


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
        length = max(FEWEST_ROWS, AT_ONCE // (members * size))
        for index, slope in zip(rows.split(length, 1), grad.split(length, 1), strict=True):
            one_hot = grad.new_zeros(members, index.shape[1], size).scatter_(2, index, 1.0)
            total.baddbmm_(one_hot.mT, slope)
        return None, total


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
        # The row of each value's first kind; and its rows in a table with KINDS for each value.
        self._first = [Constant(counts.cumsum(0) - counts) for counts in kinds]
        self._rows = [_rows_of(counts) for counts in kinds]
        self._vector = obs.size > 0
        self.size = WIDTH * len(kinds) + obs.size
        self.shapes: dict[str, tuple[int, ...]] = {}
        for i, rows in enumerate(self._rows):
            self.shapes |= {f"{i}.weight": (len(rows), WIDTH), f"{i}.bias": (1, WIDTH)}

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Draw rows of an orthogonal table, gain √2; set biases to zero.

        The table is drawn for all KINDS, so a vector does not depend on the number of kinds.
        """
        for i, (rows, cells) in enumerate(zip(self._rows, self._sizes, strict=True)):
            views[f"{i}.bias"].zero_()
            table = torch.empty(1, cells * KINDS, WIDTH, **FLOAT)
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
        cell, last = image.flatten(2), self._last[i].on(image.device)
        if cell.dtype != torch.uint8:  # may be below 0
            cell = cell.long().clamp(min=0)
        kind = torch.minimum(cell, last)
        rows = kind + self._first[i].on(image.device)
        return torch.relu(sum_of_rows(rows, views[f"{i}.weight"]) + views[f"{i}.bias"])


def _kinds(highest: Tensor) -> Tensor:
    """Return each value's number of kinds, for its highest numbers (C, H, W), (K,) int64."""
    kinds = np.clip(highest.flatten().numpy(), 0, KINDS - 1)  # torch clips no uint16
    return torch.from_numpy(kinds.astype(np.int64)) + 1


def _rows_of(kinds: Tensor) -> Tensor:
    """Return the rows of existing kinds in a table with KINDS for each value (K·KINDS, …)."""
    exists = torch.arange(KINDS, device="cpu") < kinds[:, None]
    return exists.flatten().nonzero().flatten()
