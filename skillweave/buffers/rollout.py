"""The rollout store: the rows of an on-policy learner until its next update."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave._internal.prefixes import unprefixed
from skillweave.algorithms.batches import SCHEMA, Batch, Reference, Rollout, column
from skillweave.errors import RunError
from skillweave.policies.core import Array
from skillweave.spaces import ActionCodec, obs_dtype, obs_shape, to_tensor

ONE_ROW = ("recurrent_state", "log_std")
"""Fields that have one row, whatever the number of rows of the others."""


class RolloutStore:
    """Store of batches until a ``Rollout`` of them is taken, once.

    The store has N = P·B columns as in ``Batch``. In a rollout the valid rows of a column come
    first. Several batches stand side by side, as further columns. Columns without a valid row are
    left out. Rows that are not valid repeat a valid row of their member, so their values are in
    range, and no NaN of a diverged member reaches the others.

    Args:
        members: P.
        quota: valid rows that every member must have before it learns; 0: learn from each batch.
        device: of the rollouts.
    """

    def __init__(self, members: int, quota: int = 0, device: str | torch.device = "cpu") -> None:
        self._members = members
        self._quota = quota
        self._device = torch.device(device)
        self._batches: list[dict[str, Tensor]] = []  # columns (P, T, B, …)

    def add(self, batch: Batch, log_std: Tensor | None = None) -> None:
        """Store a batch until the next update.

        Arrays of one member are not copied: they must stay as they are until then.

        Args:
            log_std: (P, 1, 1, A), of the acting policy, where it is no part of ``dist_params``.
        """
        valid, last = batch.valid_rows, batch.ended
        if not valid.any():
            return
        columns = {k: x for k, x in batch.items() if column(k).rollout}
        rows = {k: x for k, x in columns.items() if not column(k).per_env}
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
        fields = {k: self._by_member(x) for k, x in rows.items()}
        for name in columns.keys() - rows.keys() - {"truncated"}:
            fields[name] = self._by_member(columns[name][None])
        if log_std is not None:
            fields["log_std"] = log_std
        self._batches.append(fields)

    def rollout(
        self,
        gamma: Tensor,
        progress: float = 0.0,
        reference: Reference | None = None,
    ) -> Rollout | None:
        """Return a rollout of all batches since the last one; None: they are not enough yet.

        Args:
            gamma: (P,), each member's discount of one step.
            progress, reference: of the ``Rollout``.
        """
        if not self._batches or (self._quota and self._valid_rows() < self._quota):
            return None
        fields = self._batches[0] if len(self._batches) == 1 else _side_by_side(self._batches)
        self._batches = []
        steps = fields.pop("steps")
        factor = gamma.cpu()[:, None, None]
        factor = factor if (steps == 1).all() else factor**steps
        fields["discount"] = factor * ~fields.pop("terminated")
        fields = _filled_columns(fields)
        if fields["valid"].all():
            del fields["valid"]
        on_device: dict[str, Any] = {name: x.to(self._device) for name, x in fields.items()}
        on_device |= {k: x[:, 0] for k, x in on_device.items() if k in SCHEMA and SCHEMA[k].per_env}
        return Rollout(**on_device, reference=reference, progress=progress)

    def state(self) -> dict[str, Tensor]:
        """Return copies of the stored batches, to continue exactly; see ``load``."""
        return {
            f"{i}.{name}": x.clone()
            for i, fields in enumerate(self._batches)
            for name, x in fields.items()
        }

    def load(
        self, state: dict[str, Tensor], observation_space: gym.Space[Any], codec: ActionCodec
    ) -> None:
        """Restore a ``state``, of a learner in these spaces.

        Raises:
            RunError: observations or actions have other shapes or types, as spaces have changed.
        """
        obs = to_tensor(np.zeros((1, *obs_shape(observation_space)), obs_dtype(observation_space)))
        examples = {"obs": obs, "next_obs": obs, "action": to_tensor(codec.zeros(1))}
        self._batches = []
        while rows := unprefixed(str(len(self._batches)), state):
            for name, example in examples.items():
                x = rows[name]
                if x.dtype != example.dtype or x.shape[3:] != example.shape[1:]:
                    raise RunError(
                        f"the checkpoint's rows have {name!r} of {x.dtype} {tuple(x.shape[3:])}, "
                        f"where {example.dtype} {tuple(example.shape[1:])} belongs: the "
                        "environment has changed since it was written"
                    )
            self._batches.append(rows)

    def _valid_rows(self) -> int:
        """Return the number of valid rows of the member that has the fewest."""
        return int(
            torch.stack([fields["valid"].sum((1, 2)) for fields in self._batches]).sum(0).min()
        )

    def _by_member(self, x: Array) -> Tensor:
        """Reshape (T, P·B, …) to (P, T, B, …)."""
        split: Tensor = to_tensor(x).unflatten(1, (self._members, -1))
        return split.transpose(0, 1).contiguous()


def _valid_first(valid: Array, members: int) -> tuple[Array, Array]:
    """Order rows (T, N) of the store so that the valid ones of each column come first.

    Returns:
        Cells (D, N) int64, row and column as one number, where the fullest column has D valid
        rows; and a mask (D, N) bool of the valid ones. The others repeat a valid row of their
        member, or of any member if theirs has none.
    """
    count = valid.sum(0)
    is_valid: Array = np.arange(count.max())[:, None] < count
    row = np.argsort(~valid, axis=0, kind="stable")[: len(is_valid)]
    cells = row * len(count) + np.arange(len(count))
    first = np.where(is_valid[0], cells[0], valid.size).reshape(members, -1).min(1)
    first = np.where(first < valid.size, first, first.min())
    return np.where(is_valid, cells, first.repeat(len(count) // members)), is_valid


def _filled_columns(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Remove the columns without a valid row from fields (P, T, B, …).

    All members have as many columns as the member with the most filled ones, so some may remain.
    """
    filled = batch["valid"].any(1)
    if filled.all():
        return batch
    order = filled.to(torch.int8).argsort(dim=1, descending=True, stable=True)
    order = order[:, : int(filled.sum(1).max())]
    member = torch.arange(len(order), device="cpu")[:, None]
    return {
        k: x if x.shape[2] == 1 else x.transpose(1, 2)[member, order].transpose(1, 2)
        for k, x in batch.items()
    }


def _side_by_side(batches: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Join batches: their columns side by side, with as many rows as the longest has."""
    masks = [h["mask"] for h in batches if "mask" in h]
    if masks:  # a batch without a mask allows all actions
        every = [masks[0].new_ones(*h["valid"].shape, masks[0].shape[-1]) for h in batches]
        batches = [{"mask": free} | h for free, h in zip(every, batches, strict=True)]
    if "log_std" in batches[0]:  # each batch has its own
        batches = [
            h | {"log_std": h["log_std"].expand(-1, -1, h["valid"].shape[2], -1)} for h in batches
        ]
    t = max(h["valid"].shape[1] for h in batches)
    return {k: torch.cat([_padded(k, h[k], t) for h in batches], 2) for k in batches[0]}


def _padded(name: str, x: Tensor, t: int) -> Tensor:
    """Pad a field (P, T, B, …) to ``t`` rows: its first row is repeated, but not as valid."""
    more = x[:, :1].expand(-1, 0 if name in ONE_ROW else t - x.shape[1], *x.shape[2:])
    return torch.cat([x, torch.zeros_like(more) if name in ("valid", "last") else more], 1)
