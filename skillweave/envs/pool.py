"""Many environments side by side, stepped as by EnvPool: ``Pool``, its wrappers, one of them."""

from __future__ import annotations

import functools
import importlib.util
import inspect
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short, suggest
from skillweave.errors import DeclarationError, EnvError, needs_extra
from skillweave.policies.core import Array
from skillweave.spaces import pack, unpack

POOL_SEEDS = 2**30
"""Seeds of pools are taken modulo this: EnvPool takes seeds below twice as much."""


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

    def render(self, ids: Array) -> Array:
        """Return pictures of some environments; override it to draw them.

        Args:
            ids: (k,) int32, the environments.

        Returns:
            (k, H, W, 3) uint8. EnvPool draws them only if it was made with
            ``render_mode="rgb_array"``.
        """
        pictures: Array = self.pool.render(ids)
        return pictures


class _OneOfPool(gym.Env[Any, Any]):
    """The only environment of a pool; a reset to a seed makes a new pool."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # Gymnasium has it so, too

    def __init__(self, make: MakePool, spaces: tuple[Any, Any], render_mode: str | None) -> None:
        self.render_mode = render_mode
        self.observation_space, self.action_space = spaces
        self._make = make
        self._pool: Any = None  # until the first reset
        self._ids = np.zeros(1, np.int32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the one environment of the pool."""
        super().reset(seed=seed)
        if seed is not None or self._pool is None:
            new = int(self.np_random.integers(POOL_SEEDS)) if seed is None else seed % POOL_SEEDS
            self._pool = self._make(num_envs=1, threads=1, seed=new)
        obs, info = self._pool.reset(self._ids)
        return self._seen(obs), first_row(info)

    def step(self, action: Any) -> Any:
        """Step the one environment of the pool."""
        if self._pool is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        many = np.asarray(action, self.action_space.dtype)[None]
        if isinstance(self.action_space, gym.spaces.Discrete):
            many = many.astype(np.int32)  # EnvPool's
        obs, reward, terminated, truncated, info = self._pool.step(many, self._ids)
        ends = bool(terminated[0]), bool(truncated[0])
        return self._seen(obs), float(reward[0]), *ends, first_row(info)

    def render(self) -> Any:
        """Return a picture of the one environment of the pool."""
        if self.render_mode is None or self._pool is None:
            return None
        if not hasattr(self._pool, "render"):
            raise EnvError(
                f"{short(self._pool)} cannot be rendered: give it a method render(ids), which "
                "returns pictures (k, H, W, 3) uint8; PoolWrapper has one to override"
            )
        return self._pool.render(self._ids)[0]

    def _seen(self, obs: Any) -> Any:
        return unpack(self.observation_space, pack(self.observation_space, obs)[0])


def first_row(value: Any) -> Any:
    """Return the first row of an array, or of each array in a dict."""
    if isinstance(value, dict):
        return {k: first_row(v) for k, v in value.items()}
    return value[0] if np.ndim(value) else value


@checked_names
def one_of(pool: MakePool) -> Callable[..., gym.Env[Any, Any]]:
    """Return a function that makes one environment of a pool, where Gymnasium has none like it.

    ```python
    import skillweave as sw
    from skillweave.envs import one_of

    def pendulums(num_envs, threads, seed):
        return sw.envs.envpool("Pendulum-v1", num_envs, threads, seed)

    spec = sw.EnvSpec(one_of(pendulums), pool=pendulums)
    ```

    Its pictures are those of the pool's ``render``.

    Args:
        pool: makes the pool, as in ``EnvSpec(pool=)``.

    Returns:
        The function, for ``EnvSpec``. It has the name of ``pool``.

    Raises:
        DeclarationError: ``pool`` is no function.
    """
    if not callable(pool):
        raise DeclarationError(
            f"one_of() got {short(pool)}; it takes the function that makes the pool: "
            "def many(num_envs, threads, seed): return "
            "skillweave.envs.envpool('CartPole-v1', num_envs, threads, seed)"
        )

    @functools.cache  # a simulator may take half a second to load
    def spaces() -> tuple[Any, Any]:
        first = pool(num_envs=1, threads=1, seed=0)
        return first.observation_space, first.action_space

    def one(render_mode: str | None = None) -> gym.Env[Any, Any]:
        return _OneOfPool(pool, spaces(), render_mode)

    one.__name__ = str(getattr(pool, "__name__", type(pool).__name__))
    return one


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
        EnvError: EnvPool has no such environment (with a similar one).
    """
    package = installed()
    if env_id not in (known := package.list_all_envs()):
        end = suggest(env_id, known, listed=False)
        raise EnvError(f"EnvPool has no environment {short(env_id)}{end}")
    with no_precision_warnings():
        pool = package.make_gymnasium(
            env_id, num_envs=num_envs, num_threads=min(threads, num_envs), seed=seed, **kwargs
        )
        _ = pool.observation_space  # made on first use, with the warning
        return pool


def takes_ids(pool: Any) -> bool:
    """Return whether ``reset`` takes the environments to reset, as EnvPool's, also a VectorEnv."""
    first = next(iter(inspect.signature(pool.reset).parameters.values()), None)
    return first is not None and first.kind is not first.KEYWORD_ONLY


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
    before = dict(os.environ)
    if importlib.util.find_spec("envpool") is not None:
        with suppress(
            ImportError
        ):  # EnvPool imports it, after it has set a backend without windows
            importlib.import_module("matplotlib")
    try:
        with needs_extra("the EnvPool engine", "envpool"):
            import envpool as package
    finally:  # it sets variables of Matplotlib and pygame, which the whole program would use
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
    return package
