"""Images whose pixels are kinds, not brightnesses: grids of objects, as MiniGrid's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from skillweave.errors import DeclarationError
from skillweave.networks.encoders import Inputs
from skillweave.networks.stacked import Views, orthogonal_
from skillweave.ops.device import FLOAT, Constant
from skillweave.spaces import ObsCodec

KINDS = 16
"""Kinds that are told apart at most, 0 to 15: larger numbers count as 15, smaller ones as 0."""
WIDTH = 64
"""Features."""
AT_ONCE = 2**20
"""Numbers in the one-hot rows that are made at once for a gradient, about."""
FEWEST_ROWS = 32
"""One-hot rows that are made at once at least: each time the whole gradient is read and written."""


def sum_of_rows(rows: Tensor, table: Tensor) -> Tensor:
    """Return the sums of rows of a table, one table for each member.

    Args:
        rows: (P, B, K) int64, which rows are added. On a CPU the gradient is wrong where one sum
            has the same row twice.
        table: (P, R, W).

    Returns:
        (P, B, W).
    """
    if table.device.type == "cpu" and torch.is_grad_enabled():
        apply: Any = _SumOfRows.apply
        found: Tensor = apply(rows, table)
        return found
    return _sums(rows, table)


def _sums(rows: Tensor, table: Tensor) -> Tensor:
    members, size = table.shape[:2]
    if members > 1:  # the tables lie one below another
        rows = rows + torch.arange(members, device=rows.device)[:, None, None] * size
    total = F.embedding_bag(rows.flatten(0, 1), table.flatten(0, 1), mode="sum")
    return total.view(members, -1, total.shape[1])


class _SumOfRows(torch.autograd.Function):
    """Torch's own gradient sorts all rows first; on a CPU a dense product takes less time."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, table: Tensor) -> Tensor:
        """Return the sums."""
        ctx.save_for_backward(rows)
        ctx.shape = table.shape
        return _sums(rows, table)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        """Return the gradient by the table: one-hot rows, transposed, times the gradient of the sums."""
        (rows,) = ctx.saved_tensors
        members, size, _ = ctx.shape
        found = grad.new_zeros(ctx.shape)
        part = max(FEWEST_ROWS, AT_ONCE // (members * size))
        for some, own in zip(rows.split(part, 1), grad.split(part, 1), strict=True):
            one_hot = grad.new_zeros(members, some.shape[1], size).scatter_(2, some, 1.0)
            found.baddbmm_(one_hot.mT, own)
        return None, found


class CellsEncoder:
    """Each value of each cell has a learnt vector; features are the ReLU of their sum.

    This is a dense layer on the one-hot cells, without the zeros. Where the space says that a value
    is never above 5, it has six vectors, and larger numbers count as 5. Numbers beside the images
    are features as they are.
    """

    def __init__(self, obs: ObsCodec) -> None:
        if not obs.images:
            raise DeclarationError(
                'Network(encoder="cells") reads images of whole numbers, but the observations have '
                "none"
            )
        self._sizes = [math.prod(shape) for shape in obs.images]
        kinds = [_kinds(obs.highest(i)) for i in range(len(obs.images))]
        self._last = [Constant(own - 1) for own in kinds]
        # Of each value, the row of its first kind; and in a table in which all have KINDS.
        self._first = [Constant(own.cumsum(0) - own) for own in kinds]
        self._rows = [_rows_of(own) for own in kinds]
        self._vector = obs.size > 0
        self.size = WIDTH * len(kinds) + obs.size
        self.shapes: dict[str, tuple[int, ...]] = {}
        for i, rows in enumerate(self._rows):
            self.shapes |= {f"{i}.weight": (len(rows), WIDTH), f"{i}.bias": (1, WIDTH)}

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Rows of an orthogonal table, gain √2; biases zero.

        The table is drawn for all KINDS: a vector does not depend on how many kinds there are.
        """
        for i, (rows, cells) in enumerate(zip(self._rows, self._sizes, strict=True)):
            views[f"{i}.bias"].zero_()
            every = torch.empty(1, cells * KINDS, WIDTH, **FLOAT)
            for member, generator in zip(views[f"{i}.weight"], generators, strict=True):
                orthogonal_(every, math.sqrt(2.0), [generator])
                member.copy_(every[0, rows])

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Images (P, B, …) of whole numbers to features (P, B, F)."""
        found = [self._image(views, i, inputs[f"image.{i}"]) for i in range(len(self._rows))]
        if self._vector:
            found.append(inputs["vector"])
        return torch.cat(found, -1)

    def _image(self, views: Views, i: int, image: Tensor) -> Tensor:
        cell, last = image.flatten(2), self._last[i].on(image.device)
        if cell.dtype != torch.uint8:  # may be below 0
            cell = cell.long().clamp(min=0)
        kind = torch.minimum(cell, last)
        rows = kind + self._first[i].on(image.device)
        return torch.relu(sum_of_rows(rows, views[f"{i}.weight"]) + views[f"{i}.bias"])


def _kinds(highest: Tensor) -> Tensor:
    """How many kinds each value of a cell has, for the highest numbers (C, H, W), (K,) int64."""
    kinds = np.clip(highest.flatten().numpy(), 0, KINDS - 1)  # torch clips no uint16
    return torch.from_numpy(kinds.astype(np.int64)) + 1


def _rows_of(kinds: Tensor) -> Tensor:
    """Rows of kinds that exist, in a table with KINDS for each value (K·KINDS, …)."""
    exists = torch.arange(KINDS, device="cpu") < kinds[:, None]
    return exists.flatten().nonzero().flatten()
