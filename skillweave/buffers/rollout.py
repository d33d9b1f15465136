"""The rollout: T steps of N environments, in the order in which they happened."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.experience import Rollout
from skillweave.spaces import obs_dtype, obs_shape, to_tensor
from skillweave.types import Array, VecStep


class RolloutBuffer:
    """Filled a step at a time, then read once as a ``Rollout``; it need not be full.

    N = P·B columns: the environments of member 0 first, then those of member 1, and so on.
    """

    def __init__(
        self, n_steps: int, num_envs: int, members: int, observation_space: gym.Space[Any]
    ) -> None:
        self._members, self._at = members, 0
        lead, shape = (n_steps, num_envs), obs_shape(observation_space)
        self._obs = np.empty((*lead, *shape), obs_dtype(observation_space))
        self._next_obs = np.empty_like(self._obs)
        self._reward = np.empty(lead, np.float32)
        self._steps = np.empty(lead, np.float32)
        self._terminated = np.empty(lead, bool)
        self._last = np.empty(lead, bool)
        self._mask: list[Array | None] = [None] * n_steps
        self._action: list[Tensor] = []
        self._head: list[Tensor] = []

    def add(
        self, obs: Array, mask: Array | None, action: Tensor, head: Tensor, step: VecStep
    ) -> None:
        """Append one step; action (P, B, ...) and head (P, B, A) in policy units."""
        t = self._at
        self._obs[t], self._next_obs[t] = obs, step.next_obs
        self._reward[t], self._steps[t] = step.reward, step.steps
        self._terminated[t] = step.terminated
        np.logical_or(step.terminated, step.truncated, out=self._last[t])
        self._mask[t] = mask
        self._action.append(action)
        self._head.append(head)
        self._at += 1

    def read(self, gamma: Tensor) -> Rollout:
        """What was added, discounted by each member's γ (P,)."""
        done = self._at
        self._last[done - 1] = True  # the end of the rollout cuts every trajectory
        steps = self._by_member(self._steps[:done])
        alive = self._by_member(~self._terminated[:done])
        discount = gamma[:, None, None].pow(steps) * alive
        masks = [m for m in self._mask[:done] if m is not None]
        return Rollout(
            obs=self._by_member(self._obs[:done]),
            action=torch.stack(self._action, dim=1),
            reward=self._by_member(self._reward[:done]),
            discount=discount,
            next_obs=self._by_member(self._next_obs[:done]),
            last=self._by_member(self._last[:done]),
            obs_mask=self._by_member(self._masks(masks[0])) if masks else None,
            head=torch.stack(self._head, dim=1),
        )

    def _masks(self, example: Array) -> Array:
        """(T, N, A) bool; a step without a mask allows everything."""
        free = np.ones_like(example)
        return np.stack([free if m is None else m for m in self._mask[: self._at]])

    def _by_member(self, x: Array) -> Tensor:
        """(T, P·B, ...) to (P, T, B, ...)."""
        split = x.reshape(x.shape[0], self._members, -1, *x.shape[2:])
        return to_tensor(split).transpose(0, 1).contiguous()
