"""Conversion of actions between a policy's units and the environment's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.errors import EnvError
from skillweave.spaces.action_advice import unsupported_action
from skillweave.spaces.packing import check_size
from skillweave.types import Array


@dataclass(frozen=True)
class ActionCodec:
    """A converter of actions of one space.

    In policy units, discrete actions count from 0: (n,) int64, or (n, K) if ``multi``. Actions of a
    Box are (n, A) float32, where each dimension with two bounds spans [−1, 1].
    """

    space: gym.Space[Any]
    parts: tuple[int, ...]  # number of values of each part; () for a Box
    low: Array | None = None  # (A,) of a Box; the first values, if they are not all 0
    high: Array | None = None  # (A,) of a Box

    @property
    def discrete(self) -> bool:
        """Return whether actions are discrete."""
        return bool(self.parts)

    @property
    def multi(self) -> bool:
        """Return whether an action has several discrete parts."""
        return isinstance(self.space, gym.spaces.MultiDiscrete | gym.spaces.MultiBinary)

    @cached_property
    def size(self) -> int:
        """Return the number of logits or of means."""
        return sum(self.parts) or int(np.prod(self.space.shape or ()))

    def to_env(self, action: Array) -> Array:
        """Convert policy units to the environment's, (n, *shape)."""
        if self.parts:
            action = action if self.low is None else np.asarray(action + self.low)
            return self._shaped(action) if self.multi else action
        assert self.low is not None
        low, span, bounded = self.span
        # A diverged network returns NaN; it acts with 0 until training reports it.
        action = np.nan_to_num(action)
        scaled = action.astype(np.result_type(action, low))
        scaled[:, bounded] = low[bounded] + 0.5 * (action[:, bounded] + 1.0) * span[bounded]
        return self._shaped(scaled.astype(self.space.dtype).clip(self.low, self.high))

    def from_env(self, action: Array) -> Array:
        """Convert the environment's actions to policy units, clipped to the bounds of a Box."""
        if self.parts:
            units = np.asarray(action, np.int64)
            units = units.reshape(len(units), -1) if self.multi else units
            return units if self.low is None else np.asarray(units - self.low)
        assert self.low is not None
        low, span, bounded = self.span
        units = action.reshape(len(action), -1).clip(self.low, self.high)
        width = np.where(span[bounded] == 0.0, 1.0, span[bounded])  # low == high: any unit
        units[:, bounded] = (units[:, bounded] - low[bounded]) / width * 2.0 - 1.0
        return units.astype(np.float32)

    def check(self, action: Tensor) -> None:
        """Raise a ValueError where actions in policy units (…) are not in this space."""
        if self.discrete:
            most = torch.tensor(self.parts if self.multi else self.parts[0], device="cpu")
            if not bool(((action >= 0) & (action < most.to(action.device))).all()):
                raise ValueError("an action of its rows does not exist")

    def _shaped(self, action: Array) -> Array:
        shaped = action.reshape(len(action), *(self.space.shape or ()))
        return shaped.astype(self.space.dtype, copy=False)

    @cached_property
    def span(self) -> tuple[Array, Array, Array]:
        """Return a Box's lower bound, width, and whether the width is finite; (A,) each."""
        assert self.low is not None
        assert self.high is not None
        with np.errstate(over="ignore"):  # bounds at the limits of the dtype overflow: unbounded
            span = self.high - self.low
        return self.low, span, np.isfinite(span)


def action_codec(space: gym.Space[Any]) -> ActionCodec:
    """Return the codec of an action space.

    Raises:
        EnvError: the space is not supported; the message names supported ones.
    """
    kinds = gym.spaces.Discrete | gym.spaces.MultiDiscrete | gym.spaces.MultiBinary | gym.spaces.Box
    if not isinstance(space, kinds):
        raise unsupported_action(space)
    check_size(space, "action", _width(space))
    if not _width(space):
        raise EnvError(f"action space {space} holds nothing to choose")
    if isinstance(space, gym.spaces.Discrete):
        return ActionCodec(space, (int(space.n),), _first(space.start))
    if isinstance(space, gym.spaces.MultiDiscrete):
        return ActionCodec(space, tuple(space.nvec.reshape(-1).tolist()), _first(space.start))
    if isinstance(space, gym.spaces.MultiBinary):
        return ActionCodec(space, (2,) * int(np.prod(space.shape)))
    if isinstance(space, gym.spaces.Box) and np.issubdtype(space.dtype, np.floating):
        return ActionCodec(space, (), space.low.reshape(-1), space.high.reshape(-1))
    raise unsupported_action(space)


def _width(space: gym.Space[Any]) -> int:
    """Return the number of outputs of a policy's head for a space."""
    if isinstance(space, gym.spaces.Discrete):
        return int(space.n)
    if isinstance(space, gym.spaces.MultiDiscrete):
        return int(space.nvec.sum(dtype=np.float64))  # a sum of integers may overflow
    return math.prod(space.shape or ())


def _first(start: Any) -> Array | None:
    """Return the first values as an offset; None if all are 0."""
    first = np.asarray(start, np.int64)
    return (first.reshape(-1) if first.ndim else first) if first.any() else None
