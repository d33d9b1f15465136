"""Observations as what networks eat: a vector of floats, and images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.spaces.packing import LARGEST, check_size, obs_dtype, obs_shape, parts
from skillweave.types import Array, SkillweaveError

_SMALLEST = 16  # sides of a plain matrix of bytes that is an image


def to_tensor(array: Array) -> Tensor:
    """A batch of observations as a tensor, without a copy where the array is contiguous.

    A structured array (*lead,) becomes its bytes, uint8 (*lead, itemsize).
    """
    if array.dtype.fields is None:
        return torch.from_numpy(array)
    raw = np.ascontiguousarray(array).view(np.uint8)
    return torch.from_numpy(raw.reshape(*array.shape, array.dtype.itemsize))


@dataclass(frozen=True)
class ImageLayout:
    """How a Box is laid out as an image: a stack of frames, channels first or last."""

    stack: tuple[int, ...]  # (S, a, b, c)
    channels_last: bool
    peak: float  # the value that is 1 to a network

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, H, W); the frames of a stack follow each other in C."""
        s, a, b, c = self.stack
        return (s * c, a, b) if self.channels_last else (s * a, b, c)

    def read(self, x: Tensor, lead: torch.Size) -> Tensor:
        """Images (*lead, *space.shape) as (*lead, C, H, W)."""
        frames = x.reshape(*lead, *self.stack)
        if self.channels_last:
            frames = frames.movedim(-1, -3)
        return frames.flatten(-4, -3)


def image_layout(space: gym.Space[Any]) -> ImageLayout | None:
    """The layout of a space that is an image, else None.

    Images are Boxes of 3 axes, or of 4 (a stack of frames), of integers or of bounded floats,
    and matrices of bytes. The shorter of a frame's outer axes is its channels'.
    """
    if not isinstance(space, gym.spaces.Box):
        return None
    floats, axes = np.issubdtype(space.dtype, np.floating), len(space.shape)
    matrix = axes == 2 and space.dtype == np.uint8 and min(space.shape) >= _SMALLEST
    if not matrix and (axes not in (3, 4) or (floats and not space.is_bounded())):
        return None
    peak = 1.0
    if space.dtype == np.uint8:
        peak = 255.0
    elif np.issubdtype(space.dtype, np.integer):
        peak = max(1.0, float(space.high.max(initial=1)))
    stack = (1, 1, *space.shape)[-4:]
    return ImageLayout(stack, stack[3] < stack[1], peak)


@dataclass(frozen=True)
class _Leaf:
    """A part of an observation that has no parts itself."""

    shape: tuple[int, ...]
    place: slice | None  # which bytes of an observation; None: it is the whole observation
    dtype: torch.dtype
    real: bool  # a Box, not choices
    choices: tuple[int, ...] = ()  # of each entry, where it is to be one-hot
    start: tuple[int, ...] = ()  # first choice of each entry
    image: ImageLayout | None = None
    high: Array | None = field(default=None, compare=False)  # of an image: the highest numbers

    @cached_property
    def size(self) -> int:
        return sum(self.choices) if self.choices else int(np.prod(self.shape))

    def read(self, obs: Tensor) -> Tensor:
        return obs if self.place is None else obs[..., self.place].view(self.dtype)

    def vector(self, x: Tensor, lead: torch.Size) -> Tensor:
        if not self.choices:
            return x.reshape(*lead, self.size).float()
        flat = x.reshape(*lead, len(self.choices)).long()
        hot = [
            torch.nn.functional.one_hot(flat[..., i] - start, n)
            for i, (n, start) in enumerate(zip(self.choices, self.start, strict=True))
        ]
        return torch.cat(hot, dim=-1).float()


@dataclass(frozen=True)
class ObsCodec:
    """Observations of one space, split into a vector of ``size`` numbers and ``images``."""

    space: gym.Space[Any]
    size: int
    images: tuple[tuple[int, int, int], ...]  # (C, H, W) of each
    scaled: bool  # whether the vector has real numbers, which are worth normalising
    item: tuple[int, ...]  # trailing shape of what ``to_tensor`` makes
    leaves: tuple[_Leaf, ...]
    peaks: tuple[float, ...]  # of each image

    def split(self, obs: Tensor | Sequence[Tensor]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Raw observations to a vector and images.

        Args:
            obs: (*lead, *item); or of each leaf, in order, (*lead, *its shape).

        Returns:
            The vector float32 (*lead, size); each image (*lead, C, H, W) in its own dtype.
        """
        if isinstance(obs, Tensor):
            lead = obs.shape[: obs.ndim - len(self.item)]
            raw: Sequence[Tensor] = [leaf.read(obs) for leaf in self.leaves]
        else:
            lead, raw = obs[0].shape[: obs[0].ndim - len(self.leaves[0].shape)], obs
        vectors, images = [], []
        for leaf, x in zip(self.leaves, raw, strict=True):
            if leaf.image is None:
                vectors.append(leaf.vector(x, lead))
            else:
                images.append(leaf.image.read(x, lead))
        if len(vectors) == 1:
            return vectors[0], tuple(images)
        nothing = raw[0].new_empty((*lead, 0), dtype=torch.float32)
        return torch.cat(vectors, dim=-1) if vectors else nothing, tuple(images)

    @property
    def may_be_wrong(self) -> bool:
        """Whether ``check`` could find something: all bytes of an image are right, say."""
        return any(leaf.choices or leaf.dtype.is_floating_point for leaf in self.leaves)

    def check(self, obs: Tensor) -> None:
        """Raise a ValueError where raw observations (*lead, *item) cannot be of this space.

        They hold a number that is not finite, or a choice that does not exist.
        """
        for leaf in self.leaves:
            x = leaf.read(obs)
            if x.is_floating_point() and not bool(x.isfinite().all()):
                raise ValueError("an observation is not finite")
            if leaf.choices:
                flat = x.reshape(-1, len(leaf.choices)).long() - torch.tensor(
                    leaf.start, device="cpu"
                )
                if not bool(
                    ((flat >= 0) & (flat < torch.tensor(leaf.choices, device="cpu"))).all()
                ):
                    raise ValueError("an observation holds a choice that does not exist")

    def highest(self, i: int) -> Tensor:
        """The highest number that each pixel of image ``i`` may have, (C, H, W), in its dtype."""
        leaf = [leaf for leaf in self.leaves if leaf.image is not None][i]
        assert leaf.image is not None
        assert leaf.high is not None
        return leaf.image.read(torch.from_numpy(leaf.high), torch.Size())

    def pixels(self, image: Tensor, i: int) -> Tensor:
        """Image ``i`` as a network takes it: float32, integers scaled to [0, 1]."""
        peak = self.peaks[i]
        return image.float() if peak == 1.0 else image.float() / peak


def obs_codec(space: gym.Space[Any]) -> ObsCodec:
    """The codec of an observation space.

    Raises:
        SkillweaveError: the space is not supported; the message says which are.
    """
    dtype = obs_dtype(space)
    leaves = tuple(_leaves(space, dtype, None))
    vectors = [leaf for leaf in leaves if leaf.image is None]
    layouts = [leaf.image for leaf in leaves if leaf.image is not None]
    if not any(leaf.size for leaf in leaves):
        raise SkillweaveError(f"the observation space {space} holds no number: nothing can be seen")
    check_size(space, "observation", sum(leaf.size for leaf in vectors))
    pixels = sum(leaf.size for leaf in leaves) - sum(leaf.size for leaf in vectors)
    check_size(space, "observation", pixels, 16 * LARGEST)
    return ObsCodec(
        space=space,
        size=sum(leaf.size for leaf in vectors),
        images=tuple(layout.shape for layout in layouts),
        scaled=any(leaf.real for leaf in vectors),
        item=obs_shape(space) if dtype.fields is None else (dtype.itemsize,),
        leaves=leaves,
        peaks=tuple(layout.peak for layout in layouts),
    )


def _leaves(space: gym.Space[Any], dtype: np.dtype[Any], offset: int | None) -> Iterator[_Leaf]:
    """The leaves of a space whose observations of ``dtype`` lie ``offset`` bytes into the whole."""
    if dtype.fields is not None:
        for name, part in (parts(space) or {}).items():
            field, at = dtype.fields[name][:2]
            yield from _leaves(part, field.base, (offset or 0) + at)
        return
    shape, place = obs_shape(space), None
    if offset is not None:
        place = slice(offset, offset + int(np.prod(shape)) * dtype.itemsize)
    choices, start = _choices(space)
    image = image_layout(space)
    yield _Leaf(
        shape,
        place,
        torch.from_numpy(np.empty(0, dtype)).dtype,
        isinstance(space, gym.spaces.Box),
        choices,
        start,
        image,
        None if image is None else space.high,  # type: ignore[attr-defined]
    )


def _choices(space: gym.Space[Any]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """How many choices each entry has, and which is the first; empty for numbers."""
    if isinstance(space, gym.spaces.Discrete):
        return (int(space.n),), (int(space.start),)
    if isinstance(space, gym.spaces.MultiDiscrete):
        start = np.broadcast_to(space.start, space.shape)
        return tuple(space.nvec.reshape(-1).tolist()), tuple(start.reshape(-1).tolist())
    return (), ()
