"""Several engines of one kind as one, for a population's members."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skillweave.envs.engine import Engine, RawStep
from skillweave.envs.env_infos import joined_infos
from skillweave.policies.core import Array, info_rows


class JoinedEngines:
    """An engine that concatenates the environments of its parts.

    All parts have the same number of environments. Each part keeps its own seeds and states.
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
        """Return the number of steps of all environments."""
        return sum(part.steps_made for part in self.parts)

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Reset some environments; return observations (n, *obs_shape)."""
        assert seeds is None, "each part has its own seeds"
        split = self._split(ids)
        return _in_order(
            ids, [(rows, self.parts[i].reset_some(part_ids)) for i, rows, part_ids in split]
        )

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Step some environments; the others do not change."""
        if ids is None:
            actions = np.split(action, len(self.parts))
            steps = [part.step(rows) for part, rows in zip(self.parts, actions, strict=True)]
            return _joined(steps, [self._each] * len(steps))
        split = self._split(ids)
        steps = [self.parts[i].step(action[rows], part_ids) for i, rows, part_ids in split]
        step = _joined(steps, [len(rows) for _, rows, _ in split])
        order = np.argsort(np.concatenate([rows for _, rows, _ in split]))
        return RawStep(
            step.next_obs[order],
            step.reward[order],
            step.terminated[order],
            step.truncated[order],
            info_rows(step.info, order, len(order)),
        )

    def finish(self) -> None:
        """Check the environments of all parts."""
        for part in self.parts:
            part.finish()

    def mask(self) -> Array | None:
        """Return the actions allowed in the latest observations, (N, A) bool; None: always all."""
        masks = [part.mask() for part in self.parts]
        known = next((mask for mask in masks if mask is not None), None)
        if known is None:
            return None
        return np.concatenate([np.ones_like(known) if mask is None else mask for mask in masks])

    def _split(self, ids: Array) -> list[tuple[int, Array, Array]]:
        """Return for each part with ``ids``: its number, their rows, and their ids in it."""
        part, part_ids = np.divmod(ids, self._each)
        return [
            (int(i), rows, part_ids[rows])
            for i in np.unique(part)
            if len(rows := np.flatnonzero(part == i))
        ]


def _in_order(ids: Array, parts: Sequence[tuple[Array, Array]]) -> Array:
    whole = np.empty((len(ids), *parts[0][1].shape[1:]), parts[0][1].dtype)
    for rows, part in parts:
        whole[rows] = part
    return whole


def _joined(steps: Sequence[RawStep], counts: Sequence[int]) -> RawStep:
    """Return one result of a step, joined of those of several engines."""
    if len(steps) == 1:
        return steps[0]
    return RawStep(
        np.concatenate([s.next_obs for s in steps]),
        np.concatenate([s.reward for s in steps]),
        np.concatenate([s.terminated for s in steps]),
        np.concatenate([s.truncated for s in steps]),
        joined_infos([s.info for s in steps], counts),
    )
