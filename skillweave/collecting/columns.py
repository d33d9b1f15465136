"""Rows as they are collected, a step of all environments at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from skillweave.collecting.acting import Acted
from skillweave.experience import Batch
from skillweave.types import Array

if TYPE_CHECKING:
    from skillweave.collecting.skill_rows import Judged, SkillCollector


class Columns:
    """T rows of N columns, filled from the first row to the last."""

    def __init__(self, collector: SkillCollector, rows: int) -> None:
        n, obs = collector.num_envs, collector.obs
        lead, self._at = (rows, n), 0
        self._obs = np.empty((rows, *obs.shape), obs.dtype)
        self._next_obs = np.empty_like(self._obs)
        self._reward = np.empty(lead, np.float32)
        self._terminated, self._truncated = np.empty(lead, bool), np.empty(lead, bool)
        self._action: list[Array] = []
        self._head: list[Array] = []
        self._overridden: list[Array] = []
        self._masks: list[Array | None] = []
        self._next_masks: list[Array | None] = []
        self._valid: Array | None = None
        memory = collector.memory
        self._memory = None if memory is None else memory.copy()
        self._begins = collector.kept["elapsed"] == 0

    def put(
        self,
        obs: Array,
        mask: Array | None,
        acted: Acted,
        judged: Judged,
        next_obs: Array,
        next_mask: Array | None,
        valid: Array | None,
        overridden: Array | None = None,
    ) -> None:
        """Write a row: what was acted on, what was done, and what came of it."""
        at, self._at = self._at, self._at + 1
        self._obs[at], self._next_obs[at], self._reward[at] = obs, next_obs, judged.reward
        self._terminated[at], self._truncated[at] = judged.terminated, judged.truncated
        self._action.append(acted.action)
        if acted.dist_params is not None:
            self._head.append(acted.dist_params)
        self._masks.append(mask)
        self._next_masks.append(next_mask)
        if overridden is not None:
            self._overridden.append(overridden)
        if valid is not None:
            if self._valid is None:
                self._valid = np.ones(self._reward.shape, bool)
            self._valid[at] = valid

    def batch(self) -> Batch:
        """All rows."""
        valid = self._valid
        ended = self._terminated | self._truncated
        starts: Array | None = None
        if self._memory is not None:
            starts = np.empty(ended.shape, bool)
            starts[0], starts[1:] = self._begins, ended[:-1]
            if valid is not None:  # the first row after a search
                starts[1:] |= valid[1:] & ~valid[:-1]
        return Batch(
            obs=self._obs,
            action=np.stack(self._action),
            reward=self._reward,
            steps=np.ones(ended.shape, np.int64),
            terminated=self._terminated,
            truncated=self._truncated,
            next_obs=self._next_obs,
            mask=stacked(self._masks),
            next_mask=stacked(self._next_masks),
            valid=valid,
            dist_params=np.stack(self._head) if self._head else None,
            recurrent_state=self._memory,
            episode_start=starts,
            overridden=np.stack(self._overridden) if self._overridden else None,
        )


def stacked(masks: list[Any]) -> Array | None:
    """Masks (N, A), one after another; a step without one allows everything."""
    known = next((mask for mask in masks if mask is not None), None)
    if known is None:
        return None
    free = np.ones_like(known)
    return np.stack([free if mask is None else mask for mask in masks])
