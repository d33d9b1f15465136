"""Gymnasium spaces to tensors and back.

``ObsCodec`` turns observations into what networks eat; ``ActionCodec`` turns what a policy
head emits into what the environment takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.types import Array, SkillweaveError

OBSERVATIONS = "Box, Discrete, MultiDiscrete, MultiBinary"
ACTIONS = "Discrete, Box"


@dataclass(frozen=True)
class ObsCodec:
    """Observations of one space as flat float vectors of ``size`` numbers."""

    space: gym.Space[Any]
    size: int
    sizes: tuple[int, ...] = ()  # one-hot widths of a discrete space, in order
    offset: tuple[int, ...] = ()  # first value of each discrete entry

    @property
    def scaled(self) -> bool:
        """Whether running normalisation makes sense: real numbers, not one-hots."""
        return not self.sizes

    def encode(self, obs: Tensor) -> Tensor:
        """Raw observations (*lead, *space.shape) to float32 (*lead, size)."""
        lead = obs.shape[: obs.ndim - len(self.space.shape or ())]
        if not self.sizes:
            flat = obs.reshape(*lead, self.size)
            return flat if flat.dtype == torch.float32 else flat.float()
        flat = obs.reshape(*lead, len(self.sizes)).long()
        hot = [
            torch.nn.functional.one_hot(flat[..., i] - start, n)
            for i, (n, start) in enumerate(zip(self.sizes, self.offset, strict=True))
        ]
        return torch.cat(hot, dim=-1).float()


def obs_codec(space: gym.Space[Any]) -> ObsCodec:
    """The codec of an observation space.

    Raises:
        SkillweaveError: the space is not supported; the message says which are.
    """
    if isinstance(space, gym.spaces.Box):
        return ObsCodec(space, int(np.prod(space.shape)))
    if isinstance(space, gym.spaces.MultiBinary):
        return ObsCodec(space, int(np.prod(space.shape)))
    if isinstance(space, gym.spaces.Discrete):
        return ObsCodec(space, int(space.n), (int(space.n),), (int(space.start),))
    if isinstance(space, gym.spaces.MultiDiscrete):
        nvec = tuple(int(n) for n in space.nvec.reshape(-1))
        start = tuple(int(n) for n in np.asarray(space.start).reshape(-1))
        return ObsCodec(space, sum(nvec), nvec, start)
    raise SkillweaveError(
        f"observation space {space} is not supported; supported are: {OBSERVATIONS}. "
        "A gymnasium wrapper (FlattenObservation, say) can turn other spaces into these."
    )


@dataclass(frozen=True)
class ActionCodec:
    """Actions of one space; ``size`` is the width of the policy's head.

    Box actions are normalised: the policy works in units where a bounded space spans [−1, 1].
    """

    space: gym.Space[Any]
    discrete: bool
    size: int
    low: Array | None = None  # (A,), where bounded
    high: Array | None = None

    def to_env(self, action: Array) -> Array:
        """Policy units to the environment's; int64 (n,), or float (n, A) to (n, *shape)."""
        if self.discrete:
            return np.asarray(action + self.low) if self.low is not None else action
        if self.low is not None and self.high is not None:
            unit = np.clip(action, -1.0, 1.0)
            action = self.low + 0.5 * (unit + 1.0) * (self.high - self.low)
        return action.astype(self.space.dtype).reshape(-1, *(self.space.shape or ()))


def action_codec(space: gym.Space[Any]) -> ActionCodec:
    """The codec of an action space.

    Raises:
        SkillweaveError: the space is not supported; the message says which are.
    """
    if isinstance(space, gym.spaces.Discrete):
        low = np.int64(space.start) if space.start else None
        return ActionCodec(space, True, int(space.n), low)  # type: ignore[arg-type]
    if isinstance(space, gym.spaces.Box) and np.issubdtype(space.dtype, np.floating):
        size = int(np.prod(space.shape))
        if not np.isfinite(space.low).all() or not np.isfinite(space.high).all():
            return ActionCodec(space, False, size)
        return ActionCodec(space, False, size, space.low.reshape(-1), space.high.reshape(-1))
    raise SkillweaveError(
        f"action space {space} is not supported; supported are: {ACTIONS} (of floats)."
    )
