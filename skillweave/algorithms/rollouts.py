"""Rollouts as PPO learns from them: their valid cells, and random pieces of these."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from skillweave.experience import Rollout
from skillweave.networks.encoders import Inputs
from skillweave.networks.stacked import take_rows
from skillweave.ops.device import on_host


def rows_where(flags: Tensor) -> Tensor:
    """Rows of each member that are True, in order; (P, N) bool to (P, K).

    K is the largest number of any member; the others' are followed by rows that are False.
    """
    return first_true(flags, *on_host(flags.sum(1).max()))


def values_after(value: Tensor, last: Tensor, at_ends: Callable[[Tensor], Tensor]) -> Tensor:
    """What follows each row is worth: the next row's value, except at ends; (P, T, B).

    Args:
        value: (P, T, B), of each row.
        last: (P, T, B) bool, ends.
        at_ends: rows (P, K) of T·B to what follows them is worth, (P, K).
    """
    found = torch.zeros_like(value)
    found[:, :-1] = value[:, 1:]
    # Surplus rows of members with fewer ends get what the shift gave them.
    rows = rows_where(last.flatten(1))
    return found.flatten(1).scatter(1, rows, at_ends(rows)).view_as(value)


class Cells:
    """The cells of a rollout that networks run on: the valid ones, or all.

    Members with fewer valid cells than others get some that are not valid, too.
    """

    def __init__(self, rollout: Rollout, *, all_cells: bool) -> None:
        self.shape = rollout.reward.shape[1:]
        self.most = self.shape.numel()
        """The number of valid cells, of the member that has most."""
        self._rows: Tensor | None = None
        if rollout.valid is not None:
            valid = rollout.valid.flatten(1)
            (self.most,) = on_host(valid.sum(1).max())
            self._rows = None if all_cells else first_true(valid, self.most)

    def flat(self, x: Tensor) -> Tensor:
        """(P, T, B, …) to (P, N, …)."""
        return x.flatten(1, 2) if self._rows is None else take_rows(x.flatten(1, 2), self._rows)

    def flat_or_none(self, x: Tensor | None) -> Tensor | None:
        """The same of what may be missing."""
        return None if x is None else self.flat(x)

    def unflat(self, x: Tensor) -> Tensor:
        """(P, N, …) to (P, T, B, …), of all cells."""
        found: Tensor = x.unflatten(1, self.shape)
        return found

    def grid(self, x: Tensor) -> Tensor:
        """Numbers (P, N) to (P, T, B), 0 elsewhere."""
        if self._rows is not None:
            x = x.new_zeros(len(x), self.shape.numel()).scatter(1, self._rows, x)
        return self.unflat(x)


def first_true(flags: Tensor, count: int) -> Tensor:
    """The first ``count`` rows that are True, (P, count), of flags (P, N); then others."""
    order = flags.to(torch.int8).argsort(dim=1, descending=True, stable=True)
    return order[:, :count]


@dataclass(slots=True)
class Samples:
    """What PPO's loss needs of samples (P, N, …).

    Where there is a memory, they are sequences instead, (P, T, B, …).
    """

    inputs: Inputs
    action: Tensor
    log_prob: Tensor  # by the policy from which clipping and KL count
    importance: Tensor  # probability by that policy ÷ by the one that acted
    advantage: Tensor
    target: Tensor  # of the value, in units of normalised returns
    old_value: Tensor | None = None  # in the same units, where values are clipped
    reference: Tensor | None = None  # (P, N, H), distribution parameters of the policy to stay near
    mask: Tensor | None = None  # bool, allowed actions; None: all
    valid: Tensor | None = None  # bool, samples that count; None: all
    own: Tensor | None = None  # bool, those whose action was the policy's own; None: as ``valid``
    starts: Tensor | None = None  # bool, memory is empty before this row
    memory: Tensor | None = None  # (P, B, M), before the first row
    most: int = 0
    """The number of valid samples, of the member that has most."""

    @property
    def count(self) -> Tensor:
        """Valid samples of each member, (P,) float."""
        if self.valid is None:
            size = float(self.advantage[0].numel())
            return self.advantage.new_full((len(self.advantage),), size)
        return self.valid.flatten(1).sum(1).to(self.advantage.dtype)

    def changed(
        self, change: Callable[[Tensor], Tensor], memory: Callable[[Tensor], Tensor] | None = None
    ) -> Samples:
        """The same with another form: of every tensor, and of the memory."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        found: dict[str, Any] = {k: change(v) for k, v in values.items() if isinstance(v, Tensor)}
        found["inputs"] = {k: change(v) for k, v in self.inputs.items()}
        if self.memory is not None:
            found["memory"] = self.memory if memory is None else memory(self.memory)
        return replace(self, **found)


def minibatches(
    samples: Samples, rng: Sequence[torch.Generator], epochs: int, batch_size: int
) -> Iterator[Samples]:
    """Every epoch's minibatches, each member's in an order of its own.

    Args:
        samples: where there is a memory, whole columns are shuffled, so no sequence is torn.
        rng: one generator per member.
        batch_size: samples in a minibatch, about: an epoch is cut into equal parts. All of a
            smaller rollout is one minibatch.

    Yields:
        (P, b, …); with a memory (P, T, b, …), and the memory (P, b, M).
    """
    recurrent = samples.memory is not None
    rows = samples.changed(lambda x: x.transpose(1, 2)) if recurrent else samples
    size, device = rows.advantage.shape[1], rows.advantage.device
    parts = min(size, max(1, round(samples.most / batch_size)))
    for _ in range(epochs):
        order = torch.stack([torch.randperm(size, generator=g, device="cpu") for g in rng]).to(
            device
        )
        shuffle = functools.partial(take_rows, rows=order)
        shuffled = rows.changed(shuffle, shuffle)
        for part in range(parts):
            cut = functools.partial(
                _cut, rows=slice(part * size // parts, (part + 1) * size // parts)
            )
            found = shuffled.changed(cut, cut)
            yield found.changed(lambda x: x.transpose(1, 2)) if recurrent else found


def _cut(x: Tensor, rows: slice) -> Tensor:
    return x[:, rows]
