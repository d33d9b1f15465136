"""Gymnasium environments in this process: those named are stepped, the others stand still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array

from skillweave.types import Array, SkillweaveError

if TYPE_CHECKING:
    _SyncVectorEnv = SyncVectorEnv[Any, Any]
else:
    _SyncVectorEnv = SyncVectorEnv  # before Gymnasium 1.4 it is no generic class

_FITS = {float: "fO", int: "iufO", bool: "biufO"}
"""By the type of a number, the kinds of arrays that hold it as it is."""


class SyncEnvs(_SyncVectorEnv):
    """Gymnasium's vector of environments, some of which begin and act.

    ``begin`` and ``act`` stand in place of the vector's ``reset`` and ``step``, which are of all
    environments and know nothing of these.

    Args:
        makers: each makes one of the N environments.
        name: what messages call them.

    Raises:
        SkillweaveError: they have different spaces, or are one and the same.
    """

    def __init__(self, makers: Sequence[Callable[[], gym.Env[Any, Any]]], name: str) -> None:
        try:
            super().__init__(makers, autoreset_mode=AutoresetMode.DISABLED)
        except RuntimeError as error:
            raise SkillweaveError(f"{name}: its environments differ: {error}") from error
        if len({id(env.unwrapped) for env in self.envs}) < len(makers):
            raise SkillweaveError(
                f"{name} gives the same environment each time; the function must make a new one"
            )
        self._over = np.zeros(self.num_envs, bool)  # whose episode has ended
        self._discrete = isinstance(self.single_action_space, gym.spaces.Discrete)

    def begin(self, ids: Array, seeds: Array) -> tuple[Any, dict[str, Any]]:
        """Reset environments ``ids`` (n,) to ``seeds`` (n,); n observations, and infos of all."""
        obs: list[Any] = []
        infos: dict[str, Any] = {}
        for i, seed in zip(ids.tolist(), seeds, strict=True):
            one, info = self.envs[i].reset(seed=int(seed))
            obs.append(one)
            infos = self._add_info(infos, info, i)
        self._over[ids] = False
        return self._batch(obs), infos

    def act(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step environments ``ids`` (n,) by ``action`` (n, ...).

        The environments may keep what they are given: it must not change afterwards.

        Returns:
            As a vector's ``step`` does, with n rows each, but infos of all environments.
        """
        assert not self._over[ids].any(), "an episode that is over must be reset first"
        n = len(ids)
        obs: list[Any] = []
        infos: dict[str, Any] = {}
        reward, terminated, truncated = np.zeros(n), np.zeros(n, bool), np.zeros(n, bool)
        # A row of a batch that has no axes is a number of numpy's, which a Box does not contain.
        each = action.tolist() if self._discrete else map(np.asarray, action)
        for row, (i, one) in enumerate(zip(ids.tolist(), each, strict=True)):
            seen, reward[row], terminated[row], truncated[row], info = self.envs[i].step(one)
            obs.append(seen)
            if info:
                infos = self._add_info(infos, info, i)
        self._over[ids] = terminated | truncated
        return self._batch(obs), reward, terminated, truncated, infos

    def _add_info(
        self, vector_infos: dict[str, Any], env_info: dict[str, Any], env_num: int
    ) -> dict[str, Any]:
        """Add one environment's info to a batch.

        Gymnasium takes the type of the first value of a key and casts all others to it, 0.5 to 0
        for example. Here the array becomes wide enough for all.
        """
        for key, value in env_info.items():
            array = vector_infos.get(key)
            if array is None or not isinstance(array, np.ndarray):
                continue
            kind = array.dtype.kind
            if kind in _FITS.get(type(value), "") or kind not in "biuf":
                continue
            if isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating):
                if kind != "f" and isinstance(value, float | np.floating):
                    vector_infos[key] = array.astype(np.float64)
                elif kind == "b" and not isinstance(value, bool | np.bool_):
                    vector_infos[key] = array.astype(np.int64)
            elif not isinstance(value, np.ndarray | dict):
                vector_infos[key] = array.astype(object)
        return super()._add_info(vector_infos, env_info, env_num)

    def _batch(self, obs: list[Any]) -> Any:
        """Observations as one batch of the space's kind."""
        space = self.single_observation_space
        empty: Any = create_empty_array(space, len(obs), np.zeros)
        return concatenate(space, obs, empty)
