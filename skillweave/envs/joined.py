"""Several engines of one kind as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skillweave.envs.engine import Engine, RawStep
from skillweave.envs.infos import info_rows, joined_infos
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
        joined_infos([s.info for s in steps], counts),
    )
