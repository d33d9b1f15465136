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
    low: Array | None = None  # (A,), of a Box; a Discrete's first value
    high: Array | None = None  # (A,), of a Box

    def to_env(self, action: Array) -> Array:
        """Policy units to the environment's; int64 (n,), or float (n, A) to (n, *shape)."""
        if self.discrete:
            return np.asarray(action + self.low) if self.low is not None else action
        assert self.low is not None
        assert self.high is not None
        if np.isfinite(self.low).all() and np.isfinite(self.high).all():
            action = self.low + 0.5 * (action + 1.0) * (self.high - self.low)
        action = action.astype(self.space.dtype).clip(self.low, self.high)
        return action.reshape(-1, *(self.space.shape or ()))


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
        return ActionCodec(space, False, size, space.low.reshape(-1), space.high.reshape(-1))
    raise SkillweaveError(
        f"action space {space} is not supported; supported are: {ACTIONS} (of floats)."
    )


def space_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """A supported space as plain JSON; infinities become strings."""
    if isinstance(space, gym.spaces.Box):
        low, high = ([_number(x) for x in b.reshape(-1).tolist()] for b in (space.low, space.high))
        return {
            "type": "Box",
            "shape": space.shape,
            "dtype": str(space.dtype),
            "low": low,
            "high": high,
        }
    if isinstance(space, gym.spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, gym.spaces.MultiDiscrete):
        start = np.asarray(space.start)
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist(), "start": start.tolist()}
    if isinstance(space, gym.spaces.MultiBinary):
        return {
            "type": "MultiBinary",
            "n": space.n if isinstance(space.n, int) else list(space.shape),
        }
    raise SkillweaveError(f"space {space} is not supported; supported are: {OBSERVATIONS}")


def space_from_json(data: dict[str, Any]) -> gym.Space[Any]:
    """The inverse of ``space_to_json``.

    Raises:
        SkillweaveError: the JSON does not describe a supported space.
    """
    try:
        match data["type"]:
            case "Box":
                shape, dtype = tuple(data["shape"]), np.dtype(data["dtype"])
                bounds = (
                    np.array([dtype.type(x) for x in data[k]], dtype).reshape(shape)
                    for k in ("low", "high")
                )
                box: gym.Space[Any] = gym.spaces.Box(next(bounds), next(bounds), shape, dtype)
                return box
            case "Discrete":
                return gym.spaces.Discrete(data["n"], start=data["start"])
            case "MultiDiscrete":
                return gym.spaces.MultiDiscrete(data["nvec"], start=data["start"])
            case "MultiBinary":
                return gym.spaces.MultiBinary(data["n"])
    except (KeyError, TypeError, ValueError) as error:
        raise SkillweaveError(f"not a space: {data!r} ({error})") from error
    raise SkillweaveError(
        f"space type {data['type']!r} is not supported; supported are: {OBSERVATIONS}"
    )


def same_space(a: gym.Space[Any], b: gym.Space[Any]) -> bool:
    """Whether a policy made for one space can act in the other: same kind, shape and choices."""
    if type(a) is not type(b) or a.shape != b.shape:
        return False
    kinds = gym.spaces.Discrete | gym.spaces.MultiDiscrete
    return not isinstance(a, kinds) or space_to_json(a) == space_to_json(b)


def _number(x: float) -> float | str:
    return x if np.isfinite(x) else str(x)
