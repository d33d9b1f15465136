"""AgileRL's replay buffers."""

from typing import Any

import numpy as np

from skillweave.algorithms.batches import Sample
from skillweave.compat.agilerl.agent import random_seed
from skillweave.compat.transition_buffer import TransitionBuffer
from skillweave.types import Array


class MultiStepReplayBuffer:
    """Transitions whose rewards are summed over ``n_step`` steps, sampled evenly."""

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
        self.native = TransitionBuffer(memory_size, random_seed(), gamma, n_step=n_step, **how)

    def __len__(self) -> int:
        return len(self.native)

    def save2memory(self, *args: Any, is_vectorised: bool = False) -> Any:
        """Add state, action, reward, next state, termination: of one environment or of each."""
        self.native.add(*(np.asarray(x) if is_vectorised else np.asarray(x)[None] for x in args))
        self.counter += len(args[0]) if is_vectorised else 1
        return args

    def save2memoryVectEnvs(self, *args: Any) -> Any:
        """Add a transition of each environment."""
        return self.save2memory(*args, is_vectorised=True)

    save2memorySingleEnv = save2memory

    def sample(self, batch_size: int, return_idx: bool = False) -> tuple[Any, ...]:
        """Return states, actions, rewards, next states, terminations: float32 tensors (B, ...)."""
        sample = self.native.sample(batch_size)
        return (*_parts(sample), sample.index[0]) if return_idx else _parts(sample)

    def sample_from_indices(self, idxs: Array) -> tuple[Any, ...]:
        """Return the transitions at the indices of a sample from another buffer."""
        return _parts(self.native.at(idxs))


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
        sample = self.native.sample(batch_size, beta)
        return (*_parts(sample), sample.weight[0], sample.index[0])  # type: ignore[index]

    def update_priorities(self, idxs: Array, priorities: Array) -> None:
        """Set the priorities of sampled transitions."""
        self.native.update_priorities(idxs, priorities)


def _parts(sample: Sample) -> tuple[Any, ...]:
    parts = sample.obs, sample.action, sample.reward, sample.next_obs, sample.discount == 0.0
    return tuple(x[0].float().reshape(len(x[0]), *(x.shape[2:] or (1,))) for x in parts)
