"""Types that every room shares: steps, policies and arrays.

This module imports no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from gymnasium import Space

from skillweave._internal.public import lazy
from skillweave._internal.seeding import Seeds as Seeds
from skillweave.policies.core import (
    Array as Array,
    LastCall as LastCall,
    Step as Step,
    read_only as read_only,
)

if TYPE_CHECKING:
    from skillweave.export.write import Export as Export
    from skillweave.hierarchy.policy import HierarchyPolicy as HierarchyPolicy
    from skillweave.training.callback import TrainEvent as TrainEvent
    from skillweave.training.evaluation import Evaluation as Evaluation
else:
    __all__, __getattr__, __dir__ = lazy(__name__)

Memory: TypeAlias = dict[str, Array]
"""A policy's state of each environment: arrays whose first axis is the environment."""


LARGEST_REWARD = 1e15
"""The largest size of a reward: learners square sums of rewards in float32."""


def wrong_reward(rewards: Array) -> int | None:
    """Return the first row that is not finite or exceeds ``LARGEST_REWARD``; None: all fit."""
    fit = np.abs(rewards) <= LARGEST_REWARD
    return int(np.flatnonzero(~fit)[0]) if b"\0" in fit.tobytes() else None


class Policy(Protocol):
    """A policy: a map from observations to actions of n environments, with a state of each.

    ``observe`` receives every transition, so that a policy can detect that a running skill has
    terminated. Rows of ``memory`` belong to environments; a runner gathers and scatters them.
    """

    observation_space: Space[Any]
    action_space: Space[Any]
    labels: tuple[str, ...]
    """Names of its skills, in order; empty for a plain policy."""

    def start(self, n: int) -> Memory:
        """Return the initial state for n environments at the start of their episodes.

        Args:
            n: the number of environments.

        Returns:
            Arrays by name; the first axis of each is the environment.
        """
        ...

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return actions and the state after them.

        Args:
            memory: the state of the n environments.
            obs: (n, *obs_shape).
            mask: (n, A) bool, allowed actions; None: all.
            deterministic: act greedily, else sample.
            rng: the random generator of samples.

        Returns:
            Actions (n, ...), and the state after them.
        """
        ...

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the state after the environments have stepped.

        Args:
            memory: the state of the n environments, after ``act``.
            step: the transition, batched over them.

        Returns:
            The new state.
        """
        ...

    def acting(self, memory: Memory) -> Array | None:
        """Return the skill that acts in each environment.

        Args:
            memory: the state of the n environments.

        Returns:
            (n,) int64, rows of ``labels``; None: the policy has no skills.
        """
        ...


class Memoryless:
    """Base class of policies without a state."""

    labels: tuple[str, ...] = ()

    def start(self, n: int) -> Memory:
        """Return an empty state."""
        return {}

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the state unchanged."""
        return memory

    def acting(self, memory: Memory) -> Array | None:
        """Return None: the policy has no skills."""
        return None
