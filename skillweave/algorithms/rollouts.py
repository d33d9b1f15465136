"""A rollout's valid cells, and random minibatches of them, for PPO."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from skillweave.algorithms.batches import Rollout
from skillweave.networks.stacked import Inputs, take_rows
from skillweave.ops.device import on_host


def rows_where(flags: Tensor) -> Tensor:
    """Return the indices of each member's True cells of a rollout; (P, N) bool to (P, K).

    K is the largest number of True rows of any member; False rows fill up the others'.
    """
    return first_true(flags, *on_host(flags.sum(1).max()))


def values_after(value: Tensor, last: Tensor, at_ends: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the value after each row: the next row's value, except at ends; (P, T, B).

    Args:
        value: (P, T, B), of each row.
        last: (P, T, B) bool, ends.
        at_ends: maps indices (P, K) of T·B rows to the value after them, (P, K).
    """
    shifted = torch.zeros_like(value)
    shifted[:, :-1] = value[:, 1:]
    # ``at_ends`` also covers surplus rows of members with fewer ends.
    rows = rows_where(last.flatten(1))
    return shifted.flatten(1).scatter(1, rows, at_ends(rows)).view_as(value)


class Cells:
    """The cells of a rollout that networks run on: the valid ones, or all.

    Invalid cells fill up members with fewer valid cells than others.
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
        """Flatten (P, T, B, …) to (P, N, …)."""
        return x.flatten(1, 2) if self._rows is None else take_rows(x.flatten(1, 2), self._rows)

    def flat_or_none(self, x: Tensor | None) -> Tensor | None:
        """Flatten a tensor as ``flat`` does; None stays None."""
        return None if x is None else self.flat(x)

    def unflat(self, x: Tensor) -> Tensor:
        """Unflatten (P, N, …) of all cells to (P, T, B, …)."""
        cells: Tensor = x.unflatten(1, self.shape)
        return cells

    def grid(self, x: Tensor) -> Tensor:
        """Arrange numbers (P, N) as (P, T, B), with 0 in other cells."""
        if self._rows is not None:
            x = x.new_zeros(len(x), self.shape.numel()).scatter(1, self._rows, x)
        return self.unflat(x)


def first_true(flags: Tensor, count: int) -> Tensor:
    """Return the indices of the first ``count`` True rows, (P, count), then of other rows."""
    order = flags.to(torch.int8).argsort(dim=1, descending=True, stable=True)
    return order[:, :count]


@dataclass(slots=True)
class Samples:
    """Samples (P, N, …) for PPO's loss.

    For a recurrent network they are sequences instead, (P, T, B, …).
    """

    inputs: Inputs
    action: Tensor
    log_prob: Tensor  # under the policy that clipping and KL refer to
    importance: Tensor  # its probability ÷ that of the policy that acted
    advantage: Tensor
    target: Tensor  # of the value, in units of normalised returns
    old_value: Tensor | None = None  # in the same units, where values are clipped
    reference: Tensor | None = None  # (P, N, H), dist_params of the reference policy
    mask: Tensor | None = None  # bool, allowed actions; None: all
    valid: Tensor | None = None  # bool, samples that count; None: all
    own: Tensor | None = None  # bool, samples whose action is the policy's own; None: as ``valid``
    starts: Tensor | None = None  # bool, the recurrent state is empty before this row
    memory: Tensor | None = None  # (P, B, M), recurrent state before the first row
    most: int = 0
    """The number of valid samples, of the member that has most."""

    @property
    def count(self) -> Tensor:
        """Return the number of valid samples of each member, (P,) float."""
        if self.valid is None:
            size = float(self.advantage[0].numel())
            return self.advantage.new_full((len(self.advantage),), size)
        return self.valid.flatten(1).sum(1).to(self.advantage.dtype)

    def changed(
        self, change: Callable[[Tensor], Tensor], memory: Callable[[Tensor], Tensor] | None = None
    ) -> Samples:
        """Return a copy: ``change`` applied to all tensors, ``memory`` to the recurrent state."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        new: dict[str, Any] = {k: change(v) for k, v in values.items() if isinstance(v, Tensor)}
        new["inputs"] = {k: change(v) for k, v in self.inputs.items()}
        if self.memory is not None:
            new["memory"] = self.memory if memory is None else memory(self.memory)
        return replace(self, **new)


def minibatches(
    samples: Samples, rng: Sequence[torch.Generator], epochs: int, batch_size: int
) -> Iterator[Samples]:
    """Yield the minibatches of all epochs; each member has its own random order.

    Args:
        samples: of a recurrent network, whole columns are shuffled, so sequences stay complete.
        rng: one generator per member.
        batch_size: approximate samples in a minibatch: an epoch is cut into equal parts. A smaller
            rollout is one minibatch.

    Yields:
        (P, b, …); with a recurrent network (P, T, b, …), and recurrent states (P, b, M).
    """
    recurrent = samples.memory is not None
    rows = samples.changed(lambda x: x.transpose(1, 2)) if recurrent else samples
    size = rows.advantage.shape[1]
    device = rows.advantage.device
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
            minibatch = shuffled.changed(cut, cut)
            yield minibatch.changed(lambda x: x.transpose(1, 2)) if recurrent else minibatch


def _cut(x: Tensor, rows: slice) -> Tensor:
    return x[:, rows]
