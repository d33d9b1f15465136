"""Many environments side by side, as EnvPool steps them: ``Pool``, and what changes one."""

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
    """Environments of which some can be reset, or stepped, while the others stand still.

    What happens in one is a function of the pool's seed, its own number, and the resets and
    actions since: so an episode can be played again after a checkpoint.
    """

    observation_space: Any
    """Of one environment."""
    action_space: Any

    def reset(self, ids: Array) -> tuple[Any, dict[str, Any]]:
        """Begin episodes in environments ``ids`` (k,) int32: observations (k, …), and infos."""
        ...

    def step(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Act in environments ``ids`` (k,) int32.

        Args:
            action: (k, …).

        Returns:
            Observations (k, …), rewards, and (k,) bool each whether the episode has terminated or
            was truncated, and infos, whose arrays have k rows.
        """
        ...


class MakePool(Protocol):
    """Makes a pool; the same again for the same arguments."""

    def __call__(self, num_envs: int, threads: int, seed: int) -> Pool:
        """Return a pool of ``num_envs`` environments.

        Raises:
            MissingExtra: what it needs is not installed.
        """
        ...


@checked_names
class PoolWrapper:
    """A pool seen otherwise: override ``see``, or ``reset`` and ``step``.

    Args:
        pool: what is wrapped.
        observation_space: of one environment; None: as it was.
    """

    def __init__(self, pool: Any, observation_space: gym.Space[Any] | None = None) -> None:
        self.pool = pool
        self.observation_space = observation_space or pool.observation_space
        self.action_space = pool.action_space

    def see(self, obs: Any, ids: Array) -> Any:
        """What is seen of observations; here all.

        Args:
            obs: (k, …), of the pool.
            ids: (k,) int32, which environments.

        Returns:
            Observations (k, …) of ``observation_space``.
        """
        return obs

    def reset(self, ids: Array) -> tuple[Any, dict[str, Any]]:
        """Begin episodes in some environments.

        Args:
            ids: (k,) int32, which environments.

        Returns:
            Observations (k, …), and infos.
        """
        obs, info = self.pool.reset(ids)
        return self.see(obs, ids), info

    def step(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Act in some environments.

        Args:
            action: (k, …).
            ids: (k,) int32, which environments.

        Returns:
            Observations (k, …), rewards (k,), whether each episode has terminated (k,) bool or was
            truncated (k,) bool, and infos, whose arrays have k rows.
        """
        obs, reward, terminated, truncated, info = self.pool.step(action, ids)
        return self.see(obs, ids), reward, terminated, truncated, info


@checked_names
def envpool(env_id: str, num_envs: int, threads: int, seed: int, **kwargs: Any) -> Any:
    """Return a pool of EnvPool's environments.

    Args:
        env_id: EnvPool's name of it.
        num_envs: environments side by side.
        threads: that step them.
        seed: of all.
        **kwargs: EnvPool's settings of the environment.

    Returns:
        The pool, for ``PoolWrapper`` or ``EnvSpec(pool=)``.

    Raises:
        MissingExtra: EnvPool is not installed.
        EnvError: it has no such environment (with close matches).
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
    """EnvPool states bounds in float64 for float32 spaces, and Gymnasium warns of it each time."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*precision lowered.*")
        yield


def installed() -> Any:
    """Return the package ``envpool``.

    Raises:
        MissingExtra: it is not there.
    """
    try:
        import envpool as package
    except ImportError as error:
        raise MissingExtra("the EnvPool engine", "envpool") from error
    return package
