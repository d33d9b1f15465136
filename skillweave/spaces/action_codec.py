"""Conversion of actions between a policy and the environment, and advice for other spaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave._internal.messages import short
from skillweave.errors import EnvError
from skillweave.policies.core import Array
from skillweave.policies.spaces import MOST_CHOICES, MOST_OF_ALL
from skillweave.spaces.packing import check_size, leaf_spaces, obs_dtype, parts


@dataclass(frozen=True)
class ActionCodec:
    """A converter of actions of one space.

    In policy units, discrete actions count from 0: (n,) int64, or (n, K) if ``multi``; so do the
    whole numbers of a Box. Real numbers of a Box are (n, A) float32, where each dimension with two
    bounds spans [−1, 1].
    """

    space: gym.Space[Any]
    parts: tuple[int, ...]  # number of values of each part; () for real numbers
    low: Array | None = None  # (A,) of real numbers; the first values, if they are not all 0
    high: Array | None = None  # (A,) of real numbers

    @property
    def discrete(self) -> bool:
        """Return whether actions are discrete."""
        return bool(self.parts)

    @property
    def multi(self) -> bool:
        """Return whether an action has several discrete parts."""
        several = gym.spaces.MultiDiscrete | gym.spaces.MultiBinary | gym.spaces.Box
        return bool(self.parts) and isinstance(self.space, several)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Return the number of values of each choice, in order; a mask has a number for each."""
        return self.parts

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
        action = action if np.isfinite(action).all() else np.nan_to_num(action)
        if self._is_bounded:
            scaled = low + 0.5 * (action + 1.0) * span
        else:
            scaled = action.astype(np.result_type(action, low))
            scaled[:, bounded] = low[bounded] + 0.5 * (action[:, bounded] + 1.0) * span[bounded]
        return self._shaped(scaled.astype(self.space.dtype, copy=False).clip(self.low, self.high))

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

    def allowed_at_random(self, action: Array, mask: Array, rng: np.random.Generator) -> Array:
        """Return actions (n, …) with choices at random among those that ``mask`` (n, A) allows.

        Real numbers keep their values.
        """
        if not self.parts:
            return action
        scores = np.where(mask, rng.random(mask.shape), -1.0)
        parts = np.split(scores, np.cumsum(self.parts)[:-1], axis=1)
        units = np.stack([part.argmax(axis=1) for part in parts], axis=1)
        return self.to_env(units if self.multi else units[:, 0])

    def zeros(self, *lead: int) -> Array:
        """Return actions (*lead, …) in policy units whose numbers are 0."""
        if not self.discrete:
            return np.zeros((*lead, self.size), np.float32)
        return np.zeros((*lead, *([len(self.parts)] if self.multi else [])), np.int64)

    def _shaped(self, action: Array) -> Array:
        shaped = action.reshape(len(action), *(self.space.shape or ()))
        return shaped.astype(self.space.dtype, copy=False)

    @cached_property
    def _is_bounded(self) -> bool:
        return bool(self.span[2].all())

    @cached_property
    def span(self) -> tuple[Array, Array, Array]:
        """Return a Box's lower bound, width, and whether the width is finite; (A,) each."""
        assert self.low is not None
        assert self.high is not None
        with np.errstate(over="ignore"):  # bounds at the limits of the dtype overflow: unbounded
            span = self.high - self.low
        return self.low, span, np.isfinite(span)


@dataclass(frozen=True)
class JointCodec(ActionCodec):
    """A converter of actions with several parts, each of which has a codec.

    In policy units an action is a row of float32: its parts, one after another, each as its own
    codec has them.
    """

    members: tuple[tuple[str, ActionCodec], ...] = ()
    """The names and codecs of the parts."""

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Return the columns of each part in policy units."""
        found, start = [], 0
        for _, codec in self.members:
            width = max(1, len(codec.parts)) if codec.discrete else codec.size
            found.append(slice(start, start + width))
            start += width
        return tuple(found)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Return the number of values of each choice of all parts; see ``ActionCodec``."""
        return tuple(n for _, codec in self.members for n in codec.counts)

    @cached_property
    def mask_columns(self) -> tuple[slice, ...]:
        """Return the columns of each part in a mask."""
        ends = np.cumsum([0, *(sum(codec.counts) for _, codec in self.members)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @cached_property
    def size(self) -> int:
        """Return the numbers of an action in policy units."""
        last: int = self.columns[-1].stop
        return last

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Return the type of actions in the environment's units."""
        return obs_dtype(self.space)

    def units(self, action: Any, at: int) -> Any:
        """Return the parts ``at`` of actions (…, size) as their own codec has them."""
        codec = self.members[at][1]
        part = action[..., self.columns[at]]
        if not codec.discrete:
            return part
        part = part.long() if isinstance(part, Tensor) else part.astype(np.int64)
        return part if codec.multi else part[..., 0]

    def to_env(self, action: Array) -> Array:
        """Convert policy units (n, size) to actions (n,), a part of which is ``action[name]``."""
        found = np.zeros(len(action), self.dtype)
        for at, (name, codec) in enumerate(self.members):
            found[name] = codec.to_env(self.units(action, at))
        return found

    def from_env(self, action: Array) -> Array:
        """Convert actions (n,) to policy units (n, size)."""
        found = np.zeros((len(action), self.size), np.float32)
        for at, (name, codec) in enumerate(self.members):
            units = codec.from_env(np.asarray(action[name]))
            found[:, self.columns[at]] = units.reshape(len(units), -1)
        return found

    def allowed_at_random(self, action: Array, mask: Array, rng: np.random.Generator) -> Array:
        """Return actions (n,) with choices that ``mask`` (n, A) allows; see ``ActionCodec``."""
        drawn = action.copy()
        for (name, codec), columns in zip(self.members, self.mask_columns, strict=True):
            drawn[name] = codec.allowed_at_random(action[name], mask[:, columns], rng)
        return drawn


def action_codec(space: gym.Space[Any]) -> ActionCodec:
    """Return the codec of an action space.

    Raises:
        EnvError: the space is not supported; the message names its part, and supported ones.
    """
    return _codec(space, ())


def _codec(space: gym.Space[Any], place: tuple[str, ...]) -> ActionCodec:
    """Return the codec of an action space, or of its part to which the names ``place`` lead."""
    where = ".".join(place)
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        return _joint(space, place)
    kinds = gym.spaces.Discrete | gym.spaces.MultiDiscrete | gym.spaces.MultiBinary | gym.spaces.Box
    if not isinstance(space, kinds):
        raise unsupported_action(space, where)
    check_size(space, "action", _width(space))
    if not _width(space):
        advice = "leave it out" if place else "give it a number, or a choice"
        raise EnvError(f"{named_action(space, where)} holds nothing to choose: {advice}")
    if isinstance(space, gym.spaces.Discrete):
        return ActionCodec(space, (int(space.n),), _first(space.start))
    if isinstance(space, gym.spaces.MultiDiscrete):
        return ActionCodec(space, tuple(space.nvec.reshape(-1).tolist()), _first(space.start))
    if isinstance(space, gym.spaces.MultiBinary):
        return ActionCodec(space, (2,) * int(np.prod(space.shape)))
    if not np.issubdtype(space.dtype, np.floating):
        counts = values_of(space)
        if counts is None:
            raise unsupported_action(space, where)
        return ActionCodec(space, tuple(counts.tolist()), _first(space.low.reshape(-1)))
    if space.dtype.itemsize > 8:
        raise EnvError(
            f"{named_action(space, where)} is of {space.dtype}, which PyTorch does not have: let "
            "the environment take float64 there"
        )
    return ActionCodec(space, (), space.low.reshape(-1), space.high.reshape(-1))


def is_continuous(space: gym.Space[Any]) -> bool:
    """Return whether some numbers of an action are continuous."""
    if (named := parts(space)) is not None:
        return any(map(is_continuous, named.values()))
    return isinstance(space, gym.spaces.Box) and bool(np.issubdtype(space.dtype, np.floating))


def choice_counts(space: gym.Space[Any]) -> tuple[int, ...]:
    """Return the number of values of each choice of an action; (): it has none, or no codec."""
    try:
        return action_codec(space).counts
    except EnvError:
        return ()


def _joint(space: gym.Space[Any], place: tuple[str, ...]) -> JointCodec:
    """Return the codec of a Dict or Tuple.

    Raises:
        EnvError: one of its parts is not supported.
    """
    named = parts(space)
    assert named is not None
    members = tuple((name, _codec(part, (*place, name))) for name, part in named.items())
    codec = JointCodec(space, (), members=members)
    check_size(space, "action", _outputs(codec))
    return codec


def _outputs(codec: ActionCodec) -> int:
    """Return the number of logits and means of an action."""
    if not isinstance(codec, JointCodec):
        return codec.size
    return sum(_outputs(part) for _, part in codec.members)


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


ACTIONS = "Discrete, MultiDiscrete, MultiBinary, Box, and Dict and Tuple of these"


def named_action(space: gym.Space[Any], place: str) -> str:
    """Return the name of an action space, or of its part at ``place``, for messages."""
    shown = " ".join(short(space, 200).split())
    return f"the part {place} of the action space, {shown}," if place else f"action space {shown}"


def unsupported_action(space: gym.Space[Any], place: str = "") -> EnvError:
    """Return the error for an action space that is not supported; it shows a wrapper.

    Args:
        place: the names that lead to it, with dots, where it is a part of a Dict or Tuple.
    """
    what, function = "Let a function make its actions", "gymnasium.spaces.Box(...)"
    supported = ACTIONS
    if all(isinstance(leaf, gym.spaces.Box) for leaf in leaf_spaces(space).values()):
        supported += (
            f"; whole numbers of a Box need bounds and at most {MOST_CHOICES} values each, "
            f"{MOST_OF_ALL:,} in all"
        )
        what = "Let a function round real numbers to it"
        function = "gymnasium.spaces.Box(-1.0, 1.0, ...)"
    return EnvError(
        f"{named_action(space, place)} is not supported; supported are: {supported}. {what}: "
        "EnvSpec(env, wrappers=(lambda env: gymnasium.wrappers.TransformAction(env, function, "
        f"{function}),))"
    )


def values_of(space: gym.spaces.Box) -> np.ndarray[Any, Any] | None:
    """Return how many values each whole number of a Box has, (A,) int64; None: too many."""
    low, high = (x.reshape(-1).tolist() for x in (space.low, space.high))
    counts = [int(b) - int(a) + 1 for a, b in zip(low, high, strict=True)]  # Python's: no overflow
    if max(counts, default=0) > MOST_CHOICES or sum(counts) > MOST_OF_ALL:
        return None
    return np.array(counts, np.int64)
