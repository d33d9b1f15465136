"""Many environments side by side, stepped as by EnvPool: ``Pool`` and its wrappers."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import gymnasium as gym

from skillweave.arguments import checked_names
from skillweave.errors import EnvError, MissingExtra
from skillweave.messages import close_matches, short
from skillweave.types import Array


class Pool(Protocol):
    """Environments of which some can be reset or stepped, while the others do not change.

    The dynamics of each are a function of the pool's seed, its number, and its resets and actions
    since, so an episode can be repeated after a checkpoint.
    """

    observation_space: Any
    """The space of one environment."""
    action_space: Any

    def reset(self, ids: Array) -> tuple[Any, dict[str, Any]]:
        """Reset environments ``ids`` (k,) int32; return observations (k, …) and infos."""
        ...

    def step(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step environments ``ids`` (k,) int32.

        Args:
            action: (k, …).

        Returns:
            Observations (k, …), rewards (k,), terminated (k,) bool, truncated (k,) bool, and infos,
            whose arrays have k rows.
        """
        ...


class MakePool(Protocol):
    """A function that makes a pool; equal arguments make equal pools."""

    def __call__(self, num_envs: int, threads: int, seed: int) -> Pool:
        """Return a pool of ``num_envs`` environments.

        Raises:
            MissingExtra: a package that it needs is not installed.
        """
        ...


@checked_names
class PoolWrapper:
    """A wrapper that changes a pool: override ``see``, or ``reset`` and ``step``.

    Args:
        pool: the wrapped pool.
        observation_space: the new space of one environment; None: the pool's.
    """

    def __init__(self, pool: Any, observation_space: gym.Space[Any] | None = None) -> None:
        self.pool = pool
        self.observation_space = observation_space or pool.observation_space
        self.action_space = pool.action_space

    def see(self, obs: Any, ids: Array) -> Any:
        """Convert observations; by default, return them unchanged.

        Args:
            obs: (k, …), of the pool.
            ids: (k,) int32, their environments.

        Returns:
            Observations (k, …) of ``observation_space``.
        """
        return obs

    def reset(self, ids: Array) -> tuple[Any, dict[str, Any]]:
        """Reset some environments.

        Args:
            ids: (k,) int32, the environments.

        Returns:
            Observations (k, …), and infos.
        """
        obs, info = self.pool.reset(ids)
        return self.see(obs, ids), info

    def step(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step some environments.

        Args:
            action: (k, …).
            ids: (k,) int32, the environments.

        Returns:
            Observations (k, …), rewards (k,), terminated (k,) bool, truncated (k,) bool, and infos,
            whose arrays have k rows.
        """
        obs, reward, terminated, truncated, info = self.pool.step(action, ids)
        return self.see(obs, ids), reward, terminated, truncated, info


@checked_names
def envpool(env_id: str, num_envs: int, threads: int, seed: int, **kwargs: Any) -> Any:
    """Return a pool of EnvPool's environments.

    Args:
        env_id: EnvPool's id.
        num_envs: environments side by side.
        threads: threads that step them.
        seed: the seed of all.
        **kwargs: EnvPool's settings of the environment.

    Returns:
        The pool, for ``PoolWrapper`` or ``EnvSpec(pool=)``.

    Raises:
        MissingExtra: EnvPool is not installed.
        EnvError: EnvPool has no such environment (with close matches).
    """
    package = installed()
    if env_id not in (known := package.list_all_envs()):
        near = close_matches(env_id, known)
        raise EnvError(f"EnvPool has no environment {short(env_id)}.{near}")
    with no_precision_warnings():
        pool = package.make_gymnasium(
            env_id, num_envs=num_envs, num_threads=min(threads, num_envs), seed=seed, **kwargs
        )
        _ = pool.observation_space  # made on first use, with the warning
        return pool


@contextmanager
def no_precision_warnings() -> Iterator[None]:
    """Hide Gymnasium's warning of EnvPool's bounds, float64 in float32 spaces."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*precision lowered.*")
        yield


def installed() -> Any:
    """Return the package ``envpool``.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        import envpool as package
    except ImportError as error:
        raise MissingExtra("the EnvPool engine", "envpool") from error
    return package
