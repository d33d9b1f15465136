"""Any Gymnasium VectorEnv that resets in the same step, as what the loops train on."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from skillweave.envs.infos import ActionMasks, info_rows
from skillweave.seeding import Seeds
from skillweave.spaces import pack
from skillweave.types import Array, SkillweaveError, VecStep


class FromVectorEnv:
    """A ``VecEnv`` over a Gymnasium vector with ``AutoresetMode.SAME_STEP``.

    Reads from ``info`` what semi-MDPs need, where it is there: ``steps`` (τ), ``action_mask``,
    ``next_action_mask``, ``next_obs``; else every action is one step, all are allowed, and
    ``final_obs`` and ``final_info`` count.

    Raises:
        SkillweaveError: the vector resets in another way; the message says how to make it.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise SkillweaveError(
                f"{type(env).__name__} has autoreset mode {mode}; make it with "
                "vector_kwargs={'autoreset_mode': AutoresetMode.SAME_STEP}"
            )
        self.env, self.num_envs = env, env.num_envs
        self.observation_space, self.action_space = (
            env.single_observation_space,
            env.single_action_space,
        )
        self._ones = np.ones(self.num_envs, np.int64)
        self._masks = ActionMasks(self.action_space, self.num_envs)

    def reset(self, seeds: Seeds) -> Array:
        """Start all anew; observations (N, *obs_shape)."""
        obs, info = self.env.reset(seed=seeds.integer())
        self._masks.see(info)
        return pack(self.observation_space, obs)

    def mask(self) -> Array | None:
        """(N, A) bool, the actions allowed now, or None."""
        return self._masks.now

    def step(self, action: Array) -> VecStep:
        """One action in each environment."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._masks.see(info)
        space = self.observation_space
        obs = pack(space, obs)
        if "next_obs" in info:
            next_obs = pack(space, info["next_obs"])
        else:
            next_obs = obs.copy()
            for i in np.flatnonzero(terminated | truncated):
                next_obs[i] = pack(space, info["final_obs"][i])
        return VecStep(
            next_obs, obs, np.asarray(reward, np.float32), terminated,
            truncated & ~terminated, info.get("steps", self._ones), self._masks.now, info,
            self._next_mask(info, terminated | truncated),
        )  # fmt: skip

    def _next_mask(self, info: dict[str, Any], ended: Array) -> Array | None:
        """The masks of true successors; None where they are those of what to act on next."""
        now = self._masks.now
        if "next_action_mask" in info or now is None or not ended.any():
            return info.get("next_action_mask")
        rows = np.flatnonzero(ended)
        final = ActionMasks(self.action_space, self.num_envs, now)
        last = info_rows(info.get("final_info", {}), rows, self.num_envs)
        final.see(last, rows, ended[rows])
        return final.now

    def close(self) -> None:
        """Close the vector."""
        self.env.close()
