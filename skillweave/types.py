"""Types that every room shares: steps, policies and arrays.

This module imports no other module of the library, and no torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
from gymnasium import Space
from numpy.typing import NDArray

T = TypeVar("T")
Array: TypeAlias = NDArray[Any]
Memory: TypeAlias = dict[str, Array]
"""A policy's state of each environment: arrays whose first axis is the environment."""


def prefixed(prefix: str, named: Mapping[str, T]) -> dict[str, T]:
    """Return the dict with each name as ``prefix.name``."""
    return {f"{prefix}.{k}": v for k, v in named.items()}


def unprefixed(prefix: str, named: Mapping[str, T]) -> dict[str, T]:
    """Return the entries with names ``prefix.name``, as ``name``."""
    start = f"{prefix}."
    return {k.removeprefix(start): v for k, v in named.items() if k.startswith(start)}


def flat(prefix: str, value: Any) -> dict[str, Any]:
    """Flatten nested dicts to one, with dotted names."""
    if not isinstance(value, dict):
        return {prefix: value}
    flattened: dict[str, Any] = {}
    for k, v in value.items():
        flattened |= flat(f"{prefix}.{k}", v)
    return flattened


def read_only(array: Array) -> Array:
    """Return a view that cannot be written to."""
    view = array.view()
    view.setflags(False)  # type: ignore[call-arg]  # a keyword takes three times as long
    return view


LARGEST_REWARD = 1e15
"""The largest size of a reward: learners square sums of rewards in float32."""


def wrong_reward(rewards: Array) -> int | None:
    """Return the first row that is not finite or exceeds ``LARGEST_REWARD``; None: all fit."""
    fit = np.abs(rewards) <= LARGEST_REWARD
    return int(np.flatnonzero(~fit)[0]) if b"\0" in fit.tobytes() else None


@dataclass(slots=True)
class Step:
    """An environment transition in the form that a skill's methods receive, of N environments.

    Its arrays are read-only, because they are shared.

    ``elapsed`` counts the steps of the current episode or call, this one included (so it is 1
    on the first). ``timed_out`` is True where the skill's ``max_steps`` ended the call. ``goal`` is
    what the call is for, where the skill has goals (``Skill.goal_space``).
    """

    obs: Array  # (N, *obs_shape)
    action: Array  # (N,) or (N, *action_shape)
    next_obs: Array  # (N, *obs_shape), always the true successor
    reward: Array  # (N,) float32, the environment's own reward
    terminated: Array  # (N,) bool
    truncated: Array  # (N,) bool, the environment's time limit
    timed_out: Array  # (N,) bool, the skill's time limit
    elapsed: Array  # (N,) int64, steps
    info: Mapping[str, Any]  # the environment's, arrays over N
    goal: Any = None  # (N, *goal_shape), the same in all steps of a call; None: a skill without

    def __post_init__(self) -> None:
        # Runs in every step of training: a loop over the names takes three times as long.
        self.obs, self.next_obs = read_only(self.obs), read_only(self.next_obs)
        self.action, self.reward = read_only(self.action), read_only(self.reward)
        self.terminated, self.truncated = read_only(self.terminated), read_only(self.truncated)
        self.timed_out, self.elapsed = read_only(self.timed_out), read_only(self.elapsed)
        if self.goal is not None:
            self.goal = read_only(self.goal)


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
