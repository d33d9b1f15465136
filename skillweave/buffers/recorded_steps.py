"""Episodes that were recorded elsewhere, as rows for a replay store and as a file of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave.algorithms.batches import INFO, Batch
from skillweave.buffers.replay_storage import copy_into
from skillweave.policies.core import EPISODE, RUNNING, Array
from skillweave.policies.spaces import space_of
from skillweave.spaces import obs_dtype, obs_shape, to_tensor

MASK = "action_mask"
"""The key of ``info`` with the actions that are allowed after a step."""


@dataclass(frozen=True)
class RecordedSteps:
    """T steps of episodes, one after another."""

    obs: Array  # (T, *obs_shape)
    next_obs: Array  # (T, *obs_shape)
    action: Array  # (T, *action_shape), as the environment takes them
    reward: Array  # (T,) float32
    terminated: Array  # (T,) bool
    truncated: Array  # (T,) bool
    elapsed: Array  # (T,) int64, steps of the episode so far
    last: Array  # (T,) bool, the episode's last step
    info: Mapping[str, Array]  # by key, (T, …) after each step
    name: str = "data"

    def __len__(self) -> int:
        return len(self.reward)

    def room(self, num_envs: int) -> int:
        """Return the capacity that a store of ``num_envs`` columns needs for the steps.

        All columns are as long as the longest, in which an episode's end takes the place of a step.
        """
        height = -(-len(self) // num_envs)
        ends = np.add.reduceat(self.last, np.arange(0, len(self), height), dtype=np.int64)
        return num_envs * (height + int(ends.max()) + 2)

    def tensors(self) -> dict[str, Tensor]:
        """Return the steps as tensors, for a file."""
        columns = {name: getattr(self, name) for name in COLUMNS}
        arrays = columns | prefixed("info", dict(self.info))
        return {name: to_tensor(np.array(x)) for name, x in arrays.items()}

    @classmethod
    def from_tensors(
        cls,
        tensors: Mapping[str, Tensor],
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
    ) -> RecordedSteps:
        """Return the steps whose ``tensors`` were in a file.

        Raises:
            RunError: they are of other spaces.
        """
        count = len(tensors["reward"])
        seen = obs_shape(observation_space), obs_dtype(observation_space)
        act = space_of(action_space)
        kinds: dict[str, tuple[tuple[int, ...], Any]] = {
            "obs": seen,
            "next_obs": seen,
            "action": (tuple(act.shape), act.record),
            "reward": ((), np.float32),
            "elapsed": ((), np.int64),
        }
        ends = dict.fromkeys(("terminated", "truncated", "last"), ((), np.bool_))
        arrays: dict[str, Any] = {
            k: np.zeros((count, *shape), kind) for k, (shape, kind) in (kinds | ends).items()
        }
        copy_into(arrays, dict(tensors))
        info = {key: x.numpy() for key, x in unprefixed("info", dict(tensors)).items()}
        return cls(**arrays, info=info)

    def rows(self, num_envs: int, names: tuple[str, ...]) -> Batch:
        """Return the steps as raw rows (T, N): the N environments have equal parts of them.

        Where a part ends within an episode, the rest goes on in the next environment. ``valid`` is
        false in the rows that fill up the last one.

        Args:
            num_envs: N.
            names: of raw columns.
        """
        height = -(-len(self) // num_envs)
        place = np.arange(height * num_envs).reshape(num_envs, height).T
        valid = place < len(self)
        at = np.minimum(place, len(self) - 1)
        info = {INFO + key: value for key, value in self.info.items()}
        raw = {
            "env_action": self.action,
            "env_reward": self.reward,
            "env_terminated": self.terminated,
            "env_truncated": self.truncated,
            "call_elapsed": self.elapsed,
            **info,
        }
        masks = {}
        if MASK in self.info:
            allowed = self.info[MASK].astype(bool)
            # Which actions the first step of an episode allowed is not known.
            before = np.roll(allowed, 1, axis=0)
            before[self.elapsed == 1] = True
            masks = {"mask": before[at], "next_mask": allowed[at]}
        columns = {name: raw[name][at] for name in (*RAW, *names) if name in raw}
        return Batch(
            obs=self.obs[at],
            next_obs=self.next_obs[at],
            valid=valid,
            call_end=np.where(self.last[at], EPISODE, RUNNING).astype(np.int8),
            **columns,
            **masks,
        )


COLUMNS = ("obs", "next_obs", "action", "reward", "terminated", "truncated", "elapsed", "last")
RAW = ("env_action", "env_reward", "env_terminated", "env_truncated", "call_elapsed")
"""Raw columns that all rows have."""
