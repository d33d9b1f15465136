"""Words that every room shares: steps, and what acts and what learns.

This module imports nothing of the library, and no torch when it runs.
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
"""What a policy remembers of each environment: arrays whose first axis is the environment."""


def prefixed(prefix: str, named: Mapping[str, T]) -> dict[str, T]:
    """Everything under another name: ``prefix.name``."""
    return {f"{prefix}.{k}": v for k, v in named.items()}


def unprefixed(prefix: str, named: Mapping[str, T]) -> dict[str, T]:
    """What has names that begin with ``prefix.``, without it."""
    cut = len(prefix) + 1
    return {k[cut:]: v for k, v in named.items() if k.startswith(f"{prefix}.")}


def flat(prefix: str, value: Any) -> dict[str, Any]:
    """Nested dicts as one, with dotted names."""
    if not isinstance(value, dict):
        return {prefix: value}
    found: dict[str, Any] = {}
    for k, v in value.items():
        found |= flat(f"{prefix}.{k}", v)
    return found


def read_only(array: Array) -> Array:
    """Return a view that cannot be written to."""
    view = array.view()
    view.setflags(False)  # type: ignore[call-arg]  # by name it takes three times as long
    return view


LARGEST_REWARD = 1e15
"""The largest size of a reward: what learners square, sums of rewards, fits into float32."""


def wrong_reward(rewards: Array) -> int | None:
    """Return the first that is not finite or larger than ``LARGEST_REWARD``: its row; None: all fit."""
    fit = np.abs(rewards) <= LARGEST_REWARD
    return int(np.flatnonzero(~fit)[0]) if b"\0" in fit.tobytes() else None


@dataclass(slots=True)
class Step:
    """One environment transition as a skill's methods see it, batched over N environments.

    Its arrays cannot be written to: others see the same ones.

    ``elapsed`` counts the steps of the current episode or call, this one included (so it is 1
    on the first). ``timed_out`` says that the skill's own ``max_steps`` ended it here.
    """

    obs: Array  # (N, *obs_shape)
    action: Array  # (N,) or (N, *action_shape)
    next_obs: Array  # (N, *obs_shape), always the true successor
    reward: Array  # (N,) float32, the environment's own reward
    terminated: Array  # (N,) bool
    truncated: Array  # (N,) bool, the environment's time limit
    timed_out: Array  # (N,) bool, the skill's time limit
    elapsed: Array  # (N,) int64, steps
    info: Mapping[str, Any]  # the environment's, arrays over N where it tells any

    def __post_init__(self) -> None:
        # Of every step of training: a loop over the names would take three times as long.
        self.obs, self.next_obs = read_only(self.obs), read_only(self.next_obs)
        self.action, self.reward = read_only(self.action), read_only(self.reward)
        self.terminated, self.truncated = read_only(self.terminated), read_only(self.truncated)
        self.timed_out, self.elapsed = read_only(self.timed_out), read_only(self.elapsed)


class Policy(Protocol):
    """Acts: observations to actions, batched over n environments, with memory.

    ``observe`` is told every transition, so that a policy may notice that a running skill has
    terminated. Memory rows belong to environments; a runner gathers and scatters them.
    """

    observation_space: Space[Any]
    action_space: Space[Any]
    labels: tuple[str, ...]
    """Names of the skills below it, in order; empty for a plain policy."""

    def start(self, n: int) -> Memory:
        """Fresh memory for n environments at the start of their episodes.

        Args:
            n: how many environments.

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
        """What to do, and what to remember.

        Args:
            memory: of the n environments.
            obs: (n, *obs_shape).
            mask: (n, A) bool, allowed actions; None: all.
            deterministic: act greedily, else sample.
            rng: the source of chance, where it samples.

        Returns:
            Actions (n, ...), and the memory after them.
        """
        ...

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the memory after the environments answered.

        Args:
            memory: of the n environments, after ``act``.
            step: what happened, batched over them.

        Returns:
            The memory.
        """
        ...

    def acting(self, memory: Memory) -> Array | None:
        """Which of its skills acts in each environment.

        Args:
            memory: of the n environments.

        Returns:
            (n,) int64, rows of ``labels``; None: it has no skills.
        """
        ...


class Memoryless:
    """The part of a ``Policy`` that is the same for all that remember nothing."""

    labels: tuple[str, ...] = ()

    def start(self, n: int) -> Memory:
        """Nothing to remember."""
        return {}

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Nothing to notice."""
        return memory

    def acting(self, memory: Memory) -> Array | None:
        """No skills below: None."""
        return None
