"""Gymnasium environments in this process: those named are stepped, the others stand still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.envs.infos import batched_infos
from skillweave.errors import EnvError, SkillweaveError, reworded
from skillweave.spaces import obs_dtype, obs_shape, put_observation
from skillweave.types import Array


class SyncEnvs:
    """N environments, of which some begin or act.

    Args:
        makers: each makes one of the N environments.
        name: what messages call them.

    Raises:
        EnvError: they have different spaces, or are one and the same.
    """

    def __init__(self, makers: Sequence[Callable[[], gym.Env[Any, Any]]], name: str) -> None:
        self.envs: list[gym.Env[Any, Any]] = []
        try:
            for make in makers:
                self.envs.append(self._made(make))
            self._check_alike(name)
        except BaseException:
            self.close()
            raise
        self.observation_space = self.envs[0].observation_space
        self.action_space = self.envs[0].action_space
        self._dtype, self._shape = (
            obs_dtype(self.observation_space),
            obs_shape(self.observation_space),
        )
        self._parts = self._dtype.names is not None
        self._over = np.zeros(len(self.envs), bool)  # whose episode has ended
        self._discrete = isinstance(self.action_space, gym.spaces.Discrete)

    def begin(self, ids: Array, seeds: Array) -> tuple[Array, dict[str, Any]]:
        """Reset environments ``ids`` (n,) to ``seeds`` (n,).

        Returns:
            Observations (n, *obs_shape), and the infos of these n.
        """
        obs = self._empty(len(ids))
        infos: list[dict[str, Any]] = []
        for row, (i, seed) in enumerate(zip(ids.tolist(), seeds, strict=True)):
            seen, info = self.envs[i].reset(seed=int(seed))
            put_observation(self.observation_space, obs, row, seen)
            infos.append(info)
        self._over[ids] = False
        return obs, batched_infos(infos)

    def act(self, action: Array, ids: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step environments ``ids`` (n,) by ``action`` (n, ...).

        The environments may keep what they are given: it must not change afterwards.

        Returns:
            As a vector's ``step`` does, with n rows each.
        """
        assert not self._over[ids].any(), "an episode that is over must be reset first"
        n = len(ids)
        obs = self._empty(n)
        infos: list[dict[str, Any]] = []
        reward, terminated, truncated = np.zeros(n), np.zeros(n, bool), np.zeros(n, bool)
        # A row of a batch that has no axes is a number of numpy's, which a Box does not contain.
        each = action.tolist() if self._discrete else map(np.asarray, action)
        for row, (i, one) in enumerate(zip(ids.tolist(), each, strict=True)):
            seen, reward[row], terminated[row], truncated[row], info = self.envs[i].step(one)
            # At once: several environments may have one buffer for what they show.
            if self._parts:
                put_observation(self.observation_space, obs, row, seen)
            else:
                obs[row] = seen
            infos.append(info)
        self._over[ids] = terminated | truncated
        return obs, reward, terminated, truncated, batched_infos(infos)

    def close(self) -> None:
        """Close all of them."""
        for env in self.envs:
            env.close()

    def _made(self, make: Callable[[], gym.Env[Any, Any]]) -> gym.Env[Any, Any]:
        try:
            return make()
        except SkillweaveError as error:
            if not (made := len(self.envs)):
                raise
            raise reworded(
                error,
                f"{error}. {made} could be made: if there can be no more at once, set "
                f"num_envs={made} in each algorithm, the selector's too",
            ) from error

    def _empty(self, n: int) -> Array:
        # Zeros: bytes between the parts of an observation are written to files.
        return np.zeros((n, *self._shape), self._dtype)

    def _check_alike(self, name: str) -> None:
        first = self.envs[0]
        for number, env in enumerate(self.envs):
            for kind in ("observation_space", "action_space"):
                if getattr(env, kind) != getattr(first, kind):
                    raise EnvError(
                        f"{name}: its environments differ: the {kind} of environment {number} is "
                        f"{getattr(env, kind)}, that of environment 0 {getattr(first, kind)}"
                    )
        if len({id(env.unwrapped) for env in self.envs}) < len(self.envs):
            raise EnvError(
                f"{name} gives the same environment each time; the function must make a new one"
            )
