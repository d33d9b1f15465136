"""A replay buffer for a user's training loop."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch

from skillweave.algorithms.batches import Batch, Sample
from skillweave.buffers.replay import ReplayStore
from skillweave.ops.device import FLOAT
from skillweave.types import Array


class TransitionBuffer:
    """A ``ReplayStore`` of one member, made when the first transitions are added.

    Where an observation is not the successor of the one before, the episode counts as cut there.
    """

    def __init__(self, capacity: int, seed: int, gamma: float = 1.0, **how: Any) -> None:
        self._capacity = capacity
        self._gamma = torch.tensor([gamma], **FLOAT)
        self._how = how
        self._rngs = [np.random.default_rng(seed)]
        self._after = np.empty(0)
        self._buffer: ReplayStore | None = None

    def __len__(self) -> int:
        return len(self._buffer) if self._buffer else 0

    def add(self, obs: Any, action: Any, reward: Any, next_obs: Any, terminated: Any) -> None:
        """Append one transition of each of N environments; each argument has N rows."""
        before, action, reward, after, ended = (
            np.asarray(x) for x in (obs, action, reward, next_obs, terminated)
        )
        if self._buffer is None:
            self._buffer = self._made(before, action)
        elif not np.array_equal(before, self._after):
            self._buffer.cut(np.arange(len(before)))
        never = np.zeros((1, len(before)), bool)
        once = np.ones((1, len(before)), np.int64)
        reward = reward.astype(np.float32)
        self._buffer.add(
            Batch(
                obs=before[None],
                action=action[None],
                reward=reward[None],
                steps=once,
                terminated=ended.astype(bool)[None],
                truncated=never,
                next_obs=after[None],
            )
        )
        self._after = after

    def sample(self, batch: int, beta: float = 1.0) -> Sample:
        """Return B transitions at random; see ``ReplayStore.sample``."""
        assert self._buffer, "sample() before add()"
        return self._buffer.sample(batch, self._gamma, self._rngs, min(1.0, beta))

    def at(self, index: Array) -> Sample:
        """Return the transitions (B,) at the ``index`` of a sample from another buffer."""
        assert self._buffer, "at() before add()"
        return self._buffer.at(np.asarray(index)[None], None, self._gamma)

    def update_priorities(self, index: Array, priority: Any) -> None:
        """Set the priorities (B,) of sampled transitions."""
        assert self._buffer, "update_priorities() before add()"
        self._buffer.update_priorities(np.asarray(index)[None], torch.as_tensor(priority)[None])

    def _made(self, obs: Array, action: Array) -> ReplayStore:
        whole = obs.dtype.kind in "iu"
        low, high = (
            (np.iinfo(obs.dtype).min, np.iinfo(obs.dtype).max) if whole else (-np.inf, np.inf)
        )
        kind: Any = obs.dtype if whole else np.float32
        space: gym.Space[Any] = gym.spaces.Box(low, high, obs.shape[1:], kind)
        return ReplayStore(self._capacity, len(obs), 1, space, action[:1], **self._how)
