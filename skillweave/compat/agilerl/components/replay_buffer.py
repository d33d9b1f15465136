"""AgileRL's replay buffers."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch

from skillweave.algorithms.batches import Batch, Sample
from skillweave.buffers.replay import ReplayStore
from skillweave.compat.agilerl.agent import random_seed
from skillweave.ops.device import FLOAT
from skillweave.policies.core import Array


class MultiStepReplayBuffer:
    """Transitions whose rewards are summed over ``n_step`` steps, sampled evenly.

    Where a state is not the successor of the one before, the episode counts as cut there.
    """

    def __init__(
        self,
        action_dim: int,
        memory_size: int,
        field_names: list[str],
        num_envs: int,
        n_step: int = 3,
        gamma: float = 0.99,
        device: Any = None,
        **how: Any,
    ) -> None:
        self.memory_size = memory_size
        self.counter = 0
        self._gamma = torch.tensor([gamma], **FLOAT)
        self._how = {"n_step": n_step, **how}
        self._rngs = [np.random.default_rng(random_seed())]
        self._store: ReplayStore | None = None  # made when the first transitions are added
        self._after = np.empty(0)

    def __len__(self) -> int:
        return len(self._store) if self._store else 0

    @property
    def _filled(self) -> ReplayStore:
        assert self._store, "sample() before add()"
        return self._store

    def save2memory(self, *args: Any, is_vectorised: bool = False) -> Any:
        """Add state, action, reward, next state, termination: of one environment or of each."""
        before, action, reward, after, ended = (
            np.asarray(x) if is_vectorised else np.asarray(x)[None] for x in args
        )
        n = len(before)
        if self._store is None:
            kind: Any = before.dtype if before.dtype.kind in "iu" else np.float32
            space: gym.Space[Any] = gym.spaces.Box(0, 1, before.shape[1:], kind)
            self._store = ReplayStore(self.memory_size, n, 1, space, action[:1], **self._how)
        elif not np.array_equal(before, self._after):
            self._store.cut(np.arange(n))
        self._after = after
        self._store.add(
            Batch(
                obs=before[None],
                action=action[None],
                reward=reward.astype(np.float32)[None],
                steps=np.ones((1, n), np.int64),
                terminated=ended.astype(bool)[None],
                truncated=np.zeros((1, n), bool),
                next_obs=after[None],
            )
        )
        self.counter += n
        return args

    def save2memoryVectEnvs(self, *args: Any) -> Any:
        """Add a transition of each environment."""
        return self.save2memory(*args, is_vectorised=True)

    save2memorySingleEnv = save2memory

    def sample(self, batch_size: int, return_idx: bool = False) -> tuple[Any, ...]:
        """Return states, actions, rewards, next states, terminations: float32 tensors (B, ...)."""
        sample = self._drawn(batch_size)
        return (*_parts(sample), sample.index[0]) if return_idx else _parts(sample)

    def _drawn(self, batch_size: int, beta: float = 1.0) -> Sample:
        return self._filled.sample(batch_size, self._gamma, self._rngs, min(1.0, beta))

    def sample_from_indices(self, idxs: Array) -> tuple[Any, ...]:
        """Return the transitions at the indices of a sample from another buffer."""
        return _parts(self._filled.at(np.asarray(idxs)[None], None, self._gamma))


class ReplayBuffer(MultiStepReplayBuffer):
    """Transitions of one step, sampled evenly."""

    def __init__(
        self, action_dim: int, memory_size: int, field_names: list[str], device: Any = None
    ) -> None:
        super().__init__(action_dim, memory_size, field_names, 1, 1, 1.0)


class PrioritizedReplayBuffer(MultiStepReplayBuffer):
    """Transitions sampled by the size of their last error."""

    def __init__(
        self,
        action_dim: int,
        memory_size: int,
        field_names: list[str],
        num_envs: int,
        alpha: float = 0.6,
        n_step: int = 1,
        gamma: float = 0.99,
        device: Any = None,
    ) -> None:
        how: dict[str, Any] = {"prioritized": True, "alpha": alpha}
        super().__init__(action_dim, memory_size, field_names, num_envs, n_step, gamma, **how)

    def sample(self, batch_size: int, beta: float = 0.4) -> tuple[Any, ...]:
        """Return transitions as the other buffers do, then importance weights (B,) and indices."""
        sample = self._drawn(batch_size, beta)
        return (*_parts(sample), sample.weight[0], sample.index[0])  # type: ignore[index]

    def update_priorities(self, idxs: Array, priorities: Array) -> None:
        """Set the priorities of sampled transitions."""
        self._filled.update_priorities(np.asarray(idxs)[None], torch.as_tensor(priorities)[None])


def _parts(sample: Sample) -> tuple[Any, ...]:
    parts = sample.obs, sample.action, sample.reward, sample.next_obs, sample.discount == 0.0
    return tuple(x[0].float().reshape(len(x[0]), *(x.shape[2:] or (1,))) for x in parts)
