"""Images whose pixels are kinds, not brightnesses: grids of objects, as MiniGrid's."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from skillweave.networks.encoders import Inputs
from skillweave.networks.stacked import Views, orthogonal_
from skillweave.spaces import ObsCodec
from skillweave.types import SkillweaveError

KINDS = 16
"""Values of a cell that are told apart: those from here on count as the last."""
WIDTH = 64
"""Features."""
AT_ONCE = 16
"""Sums whose gradient is computed at once."""


def sum_of_rows(rows: Tensor, table: Tensor) -> Tensor:
    """``F.embedding_bag(rows, table, mode="sum")``, whose gradient is computed faster on a CPU.

    Args:
        rows: (B, K) int64, the rows of the table that are added.
        table: (R, W).

    Returns:
        (B, W).
    """
    if table.device.type == "cpu" and torch.is_grad_enabled():
        apply: Any = _SumOfRows.apply
        found: Tensor = apply(rows, table)
        return found
    return F.embedding_bag(rows, table, mode="sum")


class _SumOfRows(torch.autograd.Function):
    """Torch's own gradient first sorts all rows; this one adds them in the order of the batch."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, table: Tensor) -> Tensor:
        """The sums."""
        ctx.save_for_backward(rows)
        ctx.size = table.shape
        return F.embedding_bag(rows, table, mode="sum")

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        """The gradient by the table."""
        (rows,) = ctx.saved_tensors
        found = grad.new_zeros(ctx.size)
        # In parts, so that what is spread out here stays in the processor's cache.
        spread = grad.new_empty(min(AT_ONCE, len(rows)), rows.shape[1], grad.shape[1])
        for some, own in zip(rows.split(AT_ONCE), grad.split(AT_ONCE), strict=True):
            each = spread[: len(own)].copy_(own[:, None])
            found.index_add_(0, some.flatten(), each.flatten(0, 1))
        return None, found


class CellsEncoder:
    """Each value of each cell has a learnt vector; features are the ReLU of their sum.

    This is a dense layer on the one-hot cells, without the zeros. Numbers beside the images are
    features as they are.
    """

    def __init__(self, obs: ObsCodec) -> None:
        if not obs.images:
            raise SkillweaveError(
                'Network(encoder="cells") reads images of whole numbers, but the observations have '
                "none"
            )
        self._sizes = [math.prod(shape) for shape in obs.images]
        first = [torch.arange(cells) * KINDS for cells in self._sizes]
        self._first = {torch.device("cpu"): first}
        """By device, for each image the row of each cell's first kind."""
        self._vector = obs.size > 0
        self.size = WIDTH * len(self._sizes) + obs.size
        self.shapes: dict[str, tuple[int, ...]] = {}
        for i, cells in enumerate(self._sizes):
            self.shapes |= {f"{i}.weight": (cells * KINDS, WIDTH), f"{i}.bias": (1, WIDTH)}

    def init_(self, views: Views, generators: list[torch.Generator]) -> None:
        """Orthogonal vectors, gain √2, biases zero."""
        for name, view in views.items():
            if name.endswith("weight"):
                orthogonal_(view, math.sqrt(2.0), generators)
            else:
                view.zero_()

    def __call__(self, views: Views, inputs: Inputs) -> Tensor:
        """Images (P, B, …) of whole numbers to features (P, B, F)."""
        found = [self._image(views, i, inputs[f"image.{i}"]) for i in range(len(self._sizes))]
        if self._vector:
            found.append(inputs["vector"])
        return torch.cat(found, -1)

    def _on(self, device: torch.device) -> list[Tensor]:
        if device not in self._first:
            self._first[device] = [x.to(device) for x in self._first[torch.device("cpu")]]
        return self._first[device]

    def _image(self, views: Views, i: int, image: Tensor) -> Tensor:
        members, batch, cells = *image.shape[:2], self._sizes[i]
        table, bias = views[f"{i}.weight"], views[f"{i}.bias"]
        kind = image.reshape(members, batch, cells).long().clamp(0, KINDS - 1)
        rows = kind + self._on(image.device)[i]
        if members > 1:
            member = torch.arange(members, device=image.device) * (cells * KINDS)
            rows = rows + member[:, None, None]
        total = sum_of_rows(rows.flatten(0, 1), table.flatten(0, 1))
        return torch.relu(total.view(members, batch, WIDTH) + bias)
