"""The rollout store: an on-policy learner's own rows, until it learns from them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.buffers.held import ONE_ROW, check_held
from skillweave.experience import SCHEMA, Batch, Reference, Rollout, column
from skillweave.spaces import ActionCodec, to_tensor
from skillweave.types import Array, unprefixed


class RolloutStore:
    """Takes experience and gives it away once, as a ``Rollout``.

    N = P·B columns as in ``Experience``. In a rollout the valid rows of a column come first, one
    after another. Where several experiences are collected, they lie side by side, as further
    columns. Columns without a valid row are left out. Rows that are not valid repeat a valid one of
    their member, so nothing there is out of range, and no NaN of a member that has diverged.

    Args:
        members: P.
        quota: valid rows that every member must have before it learns; 0: learn from each
            experience.
        device: of the rollouts.
    """

    def __init__(self, members: int, quota: int = 0, device: str | torch.device = "cpu") -> None:
        self._members, self._quota, self._device = members, quota, torch.device(device)
        self._held: list[dict[str, Tensor]] = []  # columns (P, T, B, …)

    def add(self, batch: Batch, log_std: Tensor | None = None) -> None:
        """Store a batch until it is learnt from.

        Arrays of one member are not copied: they must stay as they are until then.

        Args:
            log_std: (P, 1, 1, A), of who acted in it, where it is no part of ``dist_params``.
        """
        valid, last = batch.valid_rows, batch.ended
        if not valid.any():
            return
        kept = {k: x for k, x in batch.items() if column(k).rollout}
        rows = {k: x for k, x in kept.items() if not column(k).per_env}
        rows |= {"last": last, "valid": valid}
        del rows["truncated"]
        if valid.all():
            last[-1] = True
        else:
            cells, valid = _valid_first(valid, self._members)
            rows = {k: x.reshape(-1, *x.shape[2:])[cells] for k, x in rows.items()}
            filled = np.flatnonzero(valid[0])
            rows["last"][valid.sum(0)[filled] - 1, filled] = True
            rows |= {"last": rows["last"] & valid, "valid": valid}
        held = {k: self._by_member(x) for k, x in rows.items()}
        for name in kept.keys() - rows.keys() - {"truncated"}:
            held[name] = self._by_member(kept[name][None])
        if log_std is not None:
            held["log_std"] = log_std
        self._held.append(held)

    def rollout(
        self,
        gamma: Tensor,
        progress: float = 0.0,
        reference: Reference | None = None,
    ) -> Rollout | None:
        """All that was collected since the last one; None: it is not enough yet.

        Args:
            gamma: (P,), each member's discount of one step.
            progress, reference: of the ``Rollout``.
        """
        if not self._held or (self._quota and self._valid_rows() < self._quota):
            return None
        named = self._held[0] if len(self._held) == 1 else _side_by_side(self._held)
        self._held, steps, factor = [], named.pop("steps"), gamma.cpu()[:, None, None]
        factor = factor if (steps == 1).all() else factor**steps
        named["discount"] = factor * ~named.pop("terminated")
        named = _filled_columns(named)
        if named["valid"].all():
            del named["valid"]
        parts: dict[str, Any] = {name: x.to(self._device) for name, x in named.items()}
        parts |= {k: x[:, 0] for k, x in parts.items() if k in SCHEMA and SCHEMA[k].per_env}
        return Rollout(**parts, reference=reference, progress=progress)

    def state(self) -> dict[str, Tensor]:
        """Copies of what is held, to go on exactly; see ``load``."""
        parts = {str(i): held for i, held in enumerate(self._held)}
        return {f"{i}.{k}": x.clone() for i, held in parts.items() for k, x in held.items()}

    def load(
        self, state: dict[str, Tensor], observation_space: gym.Space[Any], codec: ActionCodec
    ) -> None:
        """Go on from a ``state``, of who acts in these spaces.

        Raises:
            ValueError: it does not fit; see ``check_held``.
        """
        held: list[dict[str, Tensor]] = []
        while rows := unprefixed(str(len(held)), state):
            held.append(rows)
        check_held(held, self._members, observation_space, codec)
        self._held = held

    def _valid_rows(self) -> int:
        """Of the member that has the fewest."""
        return int(torch.stack([held["valid"].sum((1, 2)) for held in self._held]).sum(0).min())

    def _by_member(self, x: Array) -> Tensor:
        """(T, P·B, …) to (P, T, B, …)."""
        found: Tensor = to_tensor(x).unflatten(1, (self._members, -1))
        return found.transpose(0, 1).contiguous()


def _valid_first(valid: Array, members: int) -> tuple[Array, Array]:
    """Which rows (T, N) to take so that the valid ones of each column come first.

    Returns:
        (D, N) int64, rows and columns as one number, where the fullest column has D valid rows;
        and (D, N) bool, which of them are valid: the others repeat a valid one of their member,
        or of any member if theirs has none.
    """
    count = valid.sum(0)
    kept: Array = np.arange(count.max())[:, None] < count
    row = np.argsort(~valid, axis=0, kind="stable")[: len(kept)]
    cells = row * len(count) + np.arange(len(count))
    first = np.where(kept[0], cells[0], valid.size).reshape(members, -1).min(1)
    first = np.where(first < valid.size, first, first.min())
    return np.where(kept, cells, first.repeat(len(count) // members)), kept


def _filled_columns(named: dict[str, Tensor]) -> dict[str, Tensor]:
    """Fields (P, T, B, …) without the columns that hold no valid row.

    Members that have fewer others than the member with most keep some.
    """
    filled = named["valid"].any(1)
    if filled.all():
        return named
    order = filled.to(torch.int8).argsort(dim=1, descending=True, stable=True)
    order = order[:, : int(filled.sum(1).max())]
    member = torch.arange(len(order), device="cpu")[:, None]
    return {
        k: x if x.shape[2] == 1 else x.transpose(1, 2)[member, order].transpose(1, 2)
        for k, x in named.items()
    }


def _side_by_side(held: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Several experiences as one: more columns, as many rows as the longest has."""
    masks = [h["mask"] for h in held if "mask" in h]
    if masks:  # without one, all is allowed
        every = [masks[0].new_ones(*h["valid"].shape, masks[0].shape[-1]) for h in held]
        held = [{"mask": free} | h for free, h in zip(every, held, strict=True)]
    if "log_std" in held[0]:  # each was acted with one of its own
        held = [h | {"log_std": h["log_std"].expand(-1, -1, h["valid"].shape[2], -1)} for h in held]
    t = max(h["valid"].shape[1] for h in held)
    return {k: torch.cat([_padded(k, h[k], t) for h in held], 2) for k in held[0]}


def _padded(name: str, x: Tensor, t: int) -> Tensor:
    """A field (P, T, B, …) with ``t`` rows: its first is repeated, but is not valid there."""
    more = x[:, :1].expand(-1, 0 if name in ONE_ROW else t - x.shape[1], *x.shape[2:])
    return torch.cat([x, torch.zeros_like(more) if name in ("valid", "last") else more], 1)
