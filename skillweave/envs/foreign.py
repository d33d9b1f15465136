"""Any Gymnasium VectorEnv that resets in the same step, as what the loops train on."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from skillweave.envs.infos import ActionMasks, info_rows
from skillweave.seeding import Seeds
from skillweave.spaces import pack
from skillweave.types import Array, Restorable, SkillweaveError, VecStep


@runtime_checkable
class RestorableVector(Restorable, Protocol):
    """A Gymnasium vector that can be brought back to where it was."""

    def present(self) -> tuple[Any, dict[str, Any]]:
        """What to act on next, and the info that belongs to it."""
        ...


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
        self._steps_made = 0
        self.obs: Array = np.empty(0)

    @property
    def steps_made(self) -> int:
        """Steps that all environments have made: as the vector counts them, else as seen here."""
        return int(getattr(self.env, "steps_made", self._steps_made))

    def reset(self, seeds: Seeds) -> Array:
        """Start all anew; observations (N, *obs_shape)."""
        obs, info = self.env.reset(seed=seeds.integer())
        return self._see(obs, info)

    def renew(self, seeds: Seeds) -> Array:
        """Take new seeds, if the vector can; the environments that begin anew."""
        able = self._restorable
        return np.zeros(0, np.int64) if able is None else self._refreshed(able, able.renew(seeds))

    def state(self) -> dict[str, Array]:
        """All that ``restore`` needs; nothing, where the vector cannot be brought back."""
        return {} if self._restorable is None else self._restorable.state()

    def restore(self, state: dict[str, Array]) -> Array:
        """Stand where ``state`` says."""
        assert self._restorable is not None, "a state comes from a vector that can be restored"
        return self._refreshed(self._restorable, self._restorable.restore(state))

    def set_gamma(self, gamma: Array) -> None:
        """γ of one step in each environment, from now on, where the vector has one."""
        if self._restorable is not None:
            self._restorable.set_gamma(gamma)

    def mask(self) -> Array | None:
        """(N, A) bool, the actions allowed now, or None."""
        return self._masks.now

    def step(self, action: Array) -> VecStep:
        """One action in each environment."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        obs = self._see(obs, info)
        space, steps = self.observation_space, info.get("steps", self._ones)
        self._steps_made += int(steps.sum())
        if "next_obs" in info:
            next_obs = pack(space, info["next_obs"])
        else:
            next_obs = obs.copy()
            for i in np.flatnonzero(terminated | truncated):
                next_obs[i] = pack(space, info["final_obs"][i])
        return VecStep(
            next_obs, obs, np.asarray(reward, np.float32), terminated,
            truncated & ~terminated, steps, self._masks.now, info,
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

    @property
    def _restorable(self) -> RestorableVector | None:
        return self.env if isinstance(self.env, RestorableVector) else None

    def _refreshed(self, vector: RestorableVector, ids: Array) -> Array:
        self._see(*vector.present())
        return ids

    def _see(self, obs: Any, info: dict[str, Any]) -> Array:
        self._masks.see(info)
        self.obs = pack(self.observation_space, obs)
        return self.obs
