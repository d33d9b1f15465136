"""Rows of skills that learn below a selector, and of critics of skills: one for each step."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from skillweave.collecting.acting import Acted
from skillweave.collecting.columns import stacked
from skillweave.collecting.levels import Level
from skillweave.experience import Batch
from skillweave.spaces import action_codec
from skillweave.types import Array, Step

if TYPE_CHECKING:
    from skillweave.collecting.woven import WovenCollector


class Rows:
    """T rows of N columns, shared by all leaves that learn.

    Args:
        levels: whose leaves and critics learn.
    """

    def __init__(self, collector: WovenCollector, rows: int, levels: Iterable[Level]) -> None:
        n, obs = collector.num_envs, collector.obs
        lead, self._at, self._collector = (rows, n), 0, collector
        self._obs = np.empty((rows, *obs.shape), obs.dtype)
        self._next_obs = np.empty_like(self._obs)
        self._reward = np.zeros(lead, np.float32)
        self._terminated, self._truncated = np.zeros(lead, bool), np.zeros(lead, bool)
        self._owner = np.empty(lead, np.int64)  # the leaf
        self._fresh = np.empty(lead, bool)
        self._overridden = None if collector.overridden is None else np.zeros(lead, bool)
        self._goes_on = np.zeros(n, bool)  # if the same skill is called again
        self._masks: list[Array | None] = []
        self._next_masks: list[Array | None] = []
        self._heads: dict[int, Array] = {}
        self._memory: dict[int, Array] = {}
        self._critics: dict[str, CriticRows] = {}
        for level in levels:
            if level.has_critic:
                self._critics[level.path] = CriticRows(lead)
            for i, skill in level.learning.items():
                if skill.acting.memory_size:
                    memory = collector.memory[f"{level.prefix}{i}.rnn"]
                    self._memory[level.leaves[i]] = memory.copy()
        codec = action_codec(collector.engine.action_space)  # all skills act in this space
        units = codec.from_env(np.asarray(codec.space.sample())[None])
        self._action = np.zeros((*lead, *units.shape[1:]), units.dtype)

    def go_on(self, ids: Array) -> None:
        """In environments ``ids`` (k,) the skill that acted last acts again."""
        if self._at:
            on = ids[self._goes_on[ids]]
            self._truncated[self._at - 1, on] = False

    def put(
        self, step: Step, leaf: Array, fresh: Array, mask: Array | None, next_mask: Array | None
    ) -> None:
        """Write what happened in the environments: which leaf acted, and whether it began to."""
        at = self._at
        self._obs[at], self._next_obs[at] = step.obs, step.next_obs
        self._owner[at], self._fresh[at] = leaf, fresh
        if self._overridden is not None:
            self._overridden[at] = self._collector.overridden
        self._masks.append(mask)
        self._next_masks.append(next_mask)
        self._goes_on[:] = False

    def put_skill(self, leaf: int, mine: Array, acted: Acted) -> None:
        """Write what a leaf did in environments ``mine`` (k,)."""
        lead = self._reward.shape
        self._action[self._at, mine] = acted.action
        if acted.dist_params is not None:
            if leaf not in self._heads:
                self._heads[leaf] = np.zeros(
                    (*lead, *acted.dist_params.shape[1:]), acted.dist_params.dtype
                )
            self._heads[leaf][self._at, mine] = acted.dist_params

    def judge(
        self, mine: Array, reward: Array, terminated: Array, over: Array, goes_on: Array
    ) -> None:
        """Write what the step was to the leaf of environments ``mine`` (k,)."""
        at = self._at
        self._reward[at, mine], self._terminated[at, mine] = reward, terminated
        self._truncated[at, mine], self._goes_on[mine] = over, goes_on

    def put_critic(
        self,
        level: Level,
        mine: Array,
        reward: Array,
        terminated: Array,
        truncated: Array,
    ) -> None:
        """Write what the step was to a level, in environments ``mine`` (k,) where it acts."""
        if (rows := self._critics.get(level.path)) is not None:
            calls = self._collector.memory
            skill, elapsed = (calls[f"{level.prefix}{k}"][mine] for k in ("skill", "elapsed"))
            rows.put(self._at, mine, skill, elapsed == 1, reward, terminated, truncated)

    def next(self) -> None:
        """The row is full."""
        self._at += 1

    @cached_property
    def _shared(self) -> dict[str, Array | None]:
        """What is the same for all leaves, once the rows are full."""
        return {
            "steps": np.ones(self._reward.shape, np.int64),
            "mask": stacked(self._masks),
            "next_mask": stacked(self._next_masks),
        }

    def of_leaf(self, leaf: int) -> Batch:
        """What a leaf did."""
        memory = self._memory.get(leaf)
        return Batch(
            obs=self._obs, action=self._action, reward=self._reward, terminated=self._terminated,
            truncated=self._truncated, next_obs=self._next_obs, valid=self._owner == leaf,
            dist_params=self._heads.get(leaf), recurrent_state=memory,
            episode_start=None if memory is None else self._fresh,
            overridden=self._overridden, **self._shared,
        )  # fmt: skip

    def of_critic(self, path: str) -> Batch:
        """All steps of a level, for its critic."""
        rows = self._critics[path]
        return Batch(
            obs=self._obs, action=rows.skill, reward=rows.reward,
            steps=np.ones(rows.skill.shape, np.int64), terminated=rows.terminated,
            truncated=rows.truncated, next_obs=self._next_obs,
            valid=None if rows.valid.all() else rows.valid, call_start=rows.decided,
        )  # fmt: skip


class CriticRows:
    """T rows of N columns: which of a level's skills acted, and what the step was to the level."""

    def __init__(self, lead: tuple[int, int]) -> None:
        self.skill, self.reward = np.zeros(lead, np.int64), np.zeros(lead, np.float32)
        self.terminated, self.truncated = np.zeros(lead, bool), np.zeros(lead, bool)
        self.valid, self.decided = np.zeros(lead, bool), np.zeros(lead, bool)

    def put(
        self,
        at: int,
        mine: Array,
        skill: Array,
        decided: Array,
        reward: Array,
        terminated: Array,
        truncated: Array,
    ) -> None:
        """Write row ``at`` of environments ``mine`` (k,)."""
        self.skill[at, mine], self.reward[at, mine] = skill, reward
        self.decided[at, mine] = decided
        self.terminated[at, mine], self.truncated[at, mine] = terminated, truncated
        self.valid[at, mine] = True
