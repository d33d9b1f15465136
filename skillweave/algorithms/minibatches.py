"""Rollouts in random pieces: sample by sample, or in whole sequences where there is a memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from skillweave.networks.stacked import take_rows
from skillweave.seeding import Seeds


def minibatches(
    data: Mapping[str, Tensor], seeds: list[Seeds], epochs: int, batch_size: int
) -> Iterator[dict[str, Tensor]]:
    """Every epoch's minibatches, each member's in an order of its own.

    Args:
        data: (P, T, B, ...), with ``advantage`` among them. Where there is a ``memory`` (P, B, M),
            whole columns are shuffled, so that a sequence is never torn.
        seeds: one a member.
        batch_size: samples in a minibatch, about: an epoch is cut into equal parts. All of a
            smaller rollout is one minibatch.

    Yields:
        (P, b, ...); with a memory (P, T, b, ...), and the memory (P, b, M).
    """
    steps, columns = data["advantage"].shape[1:]
    recurrent = "memory" in data
    rows = {
        k: v if k == "memory" else v.transpose(1, 2) if recurrent else v.flatten(1, 2)
        for k, v in data.items()
    }
    size = columns if recurrent else steps * columns
    parts = min(size, max(1, round(steps * columns / batch_size)))
    for epoch in range(epochs):
        order = [torch.randperm(size, generator=(s / epoch).torch()) for s in seeds]
        shuffled = {k: take_rows(v, torch.stack(order)) for k, v in rows.items()}
        for part in range(parts):
            cut = slice(part * size // parts, (part + 1) * size // parts)
            batch = {k: v[:, cut] for k, v in shuffled.items()}
            if recurrent:
                batch |= {k: v.transpose(1, 2) for k, v in batch.items() if k != "memory"}
            yield batch
