"""Engines: many environments of one kind, stepped together, reset only when told.

Gymnasium resets on the next step, in the same step or never; EnvPool resets on the next step
and ignores the action sent then. An ``Engine`` knows none of this: ``step`` steps the
environments named and returns their true successors, ``reset_some`` starts those named anew.
An environment that has ended must be reset before the next step.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from skillweave.envs.checks import Watch
from skillweave.envs.workers import WorkerVector
from skillweave.spaces import pack
from skillweave.types import Array, MissingExtra, SkillweaveError


@dataclass(slots=True)
class RawStep:
    """The environments' answer, rows in the order of the ids asked for."""

    next_obs: Array  # (n, *obs_shape)
    reward: Array  # (n,) float32
    terminated: Array  # (n,) bool
    truncated: Array  # (n,) bool
    info: dict[str, Any]


class Engine(Protocol):
    """N environments of one kind; ``ids`` are row numbers, None means all of them."""

    num_envs: int
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]

    def reset(self, seed: int) -> Array:
        """Start all anew from one seed; observations (N, *obs_shape)."""
        ...

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Start some anew; observations (n, *obs_shape). ``seeds``: one each, where supported."""
        ...

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Act in some environments; the others stand still."""
        ...

    def close(self) -> None:
        """Release processes and memory."""
        ...


class Pausable(gym.Wrapper[Any, Any, Any, Any]):
    """Takes (go, action); where ``go`` is 0 the environment stands still.

    This is how some environments of a Gymnasium vector are stepped and others wait.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = gym.spaces.Tuple((gym.spaces.Discrete(2), env.action_space))
        self._obs: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start anew."""
        self._obs, info = self.env.reset(seed=seed, options=options)
        return self._obs, info

    def step(self, action: Any) -> Any:
        """Step, or stand still."""
        go, inner = action
        if not go:
            return self._obs, 0.0, False, False, {}
        # A row of a batch that has no axes is a number of numpy's, which a Box does not contain.
        one = isinstance(self.env.action_space, gym.spaces.Discrete)
        inner = int(inner) if one else np.asarray(inner)
        self._obs, reward, terminated, truncated, info = self.env.step(inner)
        return self._obs, float(reward), terminated, truncated, info


class GymnasiumEngine:
    """Gymnasium environments, in this process or in processes of their own."""

    def __init__(self, make: Any, num_envs: int, name: str, processes: bool = False) -> None:
        makers = [functools.partial(_pausable, make, i) for i in range(num_envs)]
        self._vector: Any = WorkerVector(makers, name) if processes else _vector_here(makers, name)
        self.num_envs = num_envs
        self.observation_space: gym.Space[Any] = self._vector.single_observation_space
        go_and_action: Any = self._vector.single_action_space
        self.action_space: gym.Space[Any] = go_and_action[1]
        self._watch = Watch(name, self.observation_space, num_envs)
        # A full-size action, overwritten row by row: paused rows keep whatever stands there.
        self._actions: Any = gym.vector.utils.create_empty_array(
            self.action_space, num_envs, np.zeros
        )

    def reset(self, seed: int) -> Array:
        """Start all anew from one seed; observations (N, *obs_shape)."""
        seeds = np.random.SeedSequence(seed).generate_state(self.num_envs, np.uint32) >> 1
        obs, _ = self._vector.reset(seed=[int(s) for s in seeds])
        return self._watch.begun(pack(self.observation_space, obs))

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Start some anew; observations (n, *obs_shape)."""
        mask = np.zeros(self.num_envs, bool)
        mask[ids] = True
        each: list[int | None] = [None] * self.num_envs
        for i, seed in zip(ids, seeds or (), strict=False):
            each[int(i)] = int(seed)
        obs, _ = self._vector.reset(seed=each, options={"reset_mask": mask})
        return self._watch.begun(pack(self.observation_space, obs)[ids], ids)

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Act in some environments; the others stand still."""
        go = np.ones(self.num_envs, np.int64)
        if ids is None:
            self._actions[:] = action
        else:
            go[:] = 0
            go[ids] = 1
            self._actions[ids] = action
        # A copy: environments get views of it, and may keep them.
        acted = go, self._actions.copy()
        obs, reward, terminated, truncated, info = self._vector.step(acted)
        obs = pack(self.observation_space, obs)
        if ids is not None:
            obs, reward, terminated, truncated = (
                x[ids] for x in (obs, reward, terminated, truncated)
            )
            info = _info_rows(info, ids)
        truncated = truncated & ~terminated
        raw = RawStep(obs, reward.astype(np.float32), terminated, truncated, info)
        self._watch.stepped(raw, ids)
        return raw

    def close(self) -> None:
        """Release the environments."""
        self._vector.close()


class EnvPoolEngine:
    """EnvPool's environments: C++ threads, the same dynamics, several times the speed."""

    def __init__(self, env_id: str, num_envs: int, threads: int, spaces: gym.Env[Any, Any]) -> None:
        self._id, self._threads = env_id, min(threads, num_envs)
        self._pool: Any = None
        self.num_envs = num_envs
        # EnvPool may state looser bounds; Gymnasium's are the reference (see `supports`).
        self.observation_space, self.action_space = spaces.observation_space, spaces.action_space
        self._discrete = isinstance(self.action_space, gym.spaces.Discrete)
        self._watch = Watch(env_id, self.observation_space, num_envs)

    @staticmethod
    def supports(env_id: str, reference: gym.Env[Any, Any]) -> bool:
        """Whether EnvPool is installed and has this environment with the same spaces and limit."""
        try:
            envpool = _envpool()
        except MissingExtra:
            return False
        if env_id not in envpool.list_all_envs():
            return False
        if reference.observation_space.shape is None:  # Dict, Tuple: EnvPool nests in its own way
            return False
        with _no_precision_warnings():
            spec = envpool.make_spec(env_id)
            theirs = (spec.gymnasium_observation_space, spec.gymnasium_action_space)
        ours = (reference.observation_space, reference.action_space)
        same = all(
            isinstance(a, type(b))
            and a.shape == b.shape
            and getattr(a, "n", 0) == getattr(b, "n", 0)
            for a, b in zip(ours, theirs, strict=True)
        )
        dtype = isinstance(theirs[1], gym.spaces.Discrete) or theirs[1].dtype == ours[1].dtype
        limit = reference.spec.max_episode_steps if reference.spec else None
        return bool(
            same
            and dtype
            and theirs[0].dtype == ours[0].dtype
            and spec.config.max_episode_steps == limit
        )

    def make_pool(self, seed: int) -> Any:
        """A bare pool of EnvPool's."""
        with _no_precision_warnings():
            pool = _envpool().make_gymnasium(
                self._id, num_envs=self.num_envs, num_threads=self._threads, seed=seed
            )
            _ = pool.observation_space  # made on first use, with the warning
            return pool

    def reset(self, seed: int) -> Array:
        """Start all anew from one seed; observations (N, *obs_shape)."""
        # A pool takes its seed only when made; making one takes milliseconds.
        self._pool = self.make_pool(seed)
        obs, _ = self._pool.reset()
        return self._watch.begun(np.asarray(obs))

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Start some anew; observations (n, *obs_shape)."""
        if seeds is not None:
            raise SkillweaveError("EnvPool cannot reset single environments to a seed")
        obs, _ = self._pool.reset(ids.astype(np.int32))
        return self._watch.begun(np.asarray(obs), ids)

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Act in some environments; the others stand still."""
        if self._discrete:
            action = action.astype(np.int32)
        ids = None if ids is None else ids.astype(np.int32)
        obs, reward, terminated, truncated, info = self._pool.step(action, ids)
        # An episode that terminates on the very step of its time limit arrives as truncated:
        # EnvPool computes `terminated = done & ~truncated` itself, so this cannot be told apart.
        raw = RawStep(obs, reward, terminated, truncated, info)
        self._watch.stepped(raw, ids)
        return raw

    def close(self) -> None:
        """Release the environments."""
        self._pool = None


def _pausable(make: Any, number: int) -> Pausable:
    return Pausable(make(number=number))


def _vector_here(makers: Sequence[Any], name: str) -> SyncVectorEnv[Any, Any]:
    """The environments in this process.

    Raises:
        SkillweaveError: they have different spaces, or are one and the same.
    """
    try:
        vector = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)
    except RuntimeError as error:
        raise SkillweaveError(f"{name}: its environments differ: {error}") from error
    if len({id(env.unwrapped) for env in vector.envs}) < len(makers):
        raise SkillweaveError(
            f"{name} gives the same environment each time; the function must make a new one"
        )
    return vector


@contextmanager
def _no_precision_warnings() -> Iterator[None]:
    """EnvPool states bounds in float64 for float32 spaces, and Gymnasium warns of it each time."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*precision lowered.*")
        yield


def _info_rows(info: dict[str, Any], ids: Array) -> dict[str, Any]:
    """Some environments' part of Gymnasium's batched info, nested dicts included."""
    return {
        k: _info_rows(v, ids) if isinstance(v, dict) else v[ids] if isinstance(v, np.ndarray) else v
        for k, v in info.items()
    }


def _envpool() -> Any:
    try:
        import envpool
    except ImportError as error:
        raise MissingExtra("the EnvPool engine", "envpool") from error
    return envpool
