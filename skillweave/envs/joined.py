"""Several engines of one kind as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from skillweave.envs.engine import Engine, RawStep
from skillweave.envs.infos import info_rows
from skillweave.types import Array


class JoinedEngines:
    """An engine whose environments are those of its parts, one part after another.

    All parts have as many environments. It steps them; seeds and states are the parts' own.
    """

    def __init__(self, parts: Sequence[Engine]) -> None:
        self.parts = list(parts)
        self._each = parts[0].num_envs
        self.num_envs = self._each * len(self.parts)
        self.observation_space = parts[0].observation_space
        self.action_space = parts[0].action_space
        self.time_limit = parts[0].time_limit

    @property
    def steps_made(self) -> int:
        """Steps that all environments have made."""
        return sum(part.steps_made for part in self.parts)

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Start some anew; observations (n, *obs_shape)."""
        assert seeds is None, "the parts have seeds of their own"
        return _in_order(ids, [
            (rows, self.parts[i].reset_some(own)) for i, rows, own in self._split(ids)
        ])  # fmt: skip

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Act in some environments; the others stand still."""
        if ids is None:
            actions = np.split(action, len(self.parts))
            steps = [part.step(own) for part, own in zip(self.parts, actions, strict=True)]
            return _joined(steps, [self._each] * len(steps))
        split = self._split(ids)
        steps = [self.parts[i].step(action[rows], own) for i, rows, own in split]
        found = _joined(steps, [len(rows) for _, rows, _ in split])
        order = np.argsort(np.concatenate([rows for _, rows, _ in split]))
        return RawStep(
            found.next_obs[order], found.reward[order], found.terminated[order],
            found.truncated[order], info_rows(found.info, order, len(order)),
        )  # fmt: skip

    def mask(self) -> Array | None:
        """(N, A) bool, the actions allowed in the latest observations; None: all always are."""
        masks = [part.mask() for part in self.parts]
        known = next((mask for mask in masks if mask is not None), None)
        if known is None:
            return None
        return np.concatenate([np.ones_like(known) if mask is None else mask for mask in masks])

    def _split(self, ids: Array) -> list[tuple[int, Array, Array]]:
        """For each part concerned: its number, the rows of ``ids``, and its own ids."""
        part, own = np.divmod(ids, self._each)
        return [
            (int(i), rows, own[rows])
            for i in np.unique(part)
            if len(rows := np.flatnonzero(part == i))
        ]


def _in_order(ids: Array, found: Sequence[tuple[Array, Array]]) -> Array:
    whole = np.empty((len(ids), *found[0][1].shape[1:]), found[0][1].dtype)
    for rows, part in found:
        whole[rows] = part
    return whole


def _joined(steps: Sequence[RawStep], counts: Sequence[int]) -> RawStep:
    if len(steps) == 1:
        return steps[0]
    return RawStep(
        np.concatenate([s.next_obs for s in steps]),
        np.concatenate([s.reward for s in steps]),
        np.concatenate([s.terminated for s in steps]),
        np.concatenate([s.truncated for s in steps]),
        _infos([s.info for s in steps], counts),
    )


def _infos(infos: Sequence[dict[str, Any]], counts: Sequence[int]) -> dict[str, Any]:
    """What parts of so many environments tell, array by array, nested dicts included.

    Where a part tells nothing stand zeros, or None among objects, as Gymnasium has them.
    """
    found: dict[str, Any] = {}
    for name in dict.fromkeys(name for info in infos for name in info):
        values = [info.get(name) for info in infos]
        told = [value for value in values if value is not None]
        if all(isinstance(value, dict) for value in told):
            found[name] = _infos([value or {} for value in values], counts)
            continue
        if not all(isinstance(value, np.ndarray) and value.ndim for value in told):
            continue
        shapes = {value.shape[1:] for value in told}
        kinds = {value.dtype.kind for value in told}
        whole = len(shapes) == 1 and "O" not in kinds
        found[name] = np.concatenate(
            [
                _nothing(count, told[0], whole)
                if value is None
                else value
                if whole
                else _each(value)
                for value, count in zip(values, counts, strict=True)
            ]
        )
    return found


def _nothing(count: int, example: Array, whole: bool) -> Array:
    """Rows of a part that tells nothing."""
    if not whole:
        return np.full(count, None, object)
    return np.zeros((count, *example.shape[1:]), example.dtype)


def _each(value: Array) -> Array:
    """The rows of an array as objects."""
    rows = np.full(len(value), None, object)
    for row, one in enumerate(value):
        rows[row] = one
    return rows
