"""The interface of policies that users write: a state goes in, and the state after it comes out.

Inside of the library policies change their memory in place (``policies/core.py``).
"""

from __future__ import annotations

from typing import Any, Protocol, TypeAlias

import numpy as np
from gymnasium import Space

from skillweave.policies.core import Array, Step

Memory: TypeAlias = dict[str, Array]
"""A policy's state of each environment: arrays whose first axis is the environment."""


class Policy(Protocol):
    """A policy as users write it: observations to actions of n environments, with a state.

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


def is_policy(value: Any) -> bool:
    """Return whether a value is a policy, of this library or of the user's own."""
    return not isinstance(value, type) and hasattr(value, "act") and hasattr(value, "start")


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
