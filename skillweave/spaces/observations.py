"""Observations as inputs of networks: a vector of floats, and images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.errors import EnvError
from skillweave.policies.core import Array
from skillweave.spaces.packing import (
    LARGEST,
    check_size,
    leaf_spaces,
    obs_dtype,
    obs_shape,
)

_SMALLEST = 16  # sides of a plain matrix of bytes that is an image
_WIDEST = 2.0**24
"""The widest range of pixels: wider bounds belong to the data type, not to an image."""
_PICTURE = 36  # the least side of a picture, as opposed to a board


def to_tensor(array: Array) -> Tensor:
    """Convert a batch of observations to a tensor, without a copy if PyTorch can share the array.

    A structured array (*lead,) becomes its bytes, uint8 (*lead, itemsize).
    """
    if not array.flags.writeable or min(array.strides, default=0) < 0:
        array = array.copy()
    if array.dtype.fields is None:
        return torch.from_numpy(array)
    raw = np.ascontiguousarray(array).view(np.uint8)
    return torch.from_numpy(raw.reshape(*array.shape, array.dtype.itemsize))


@dataclass(frozen=True)
class ImageLayout:
    """The layout of a Box as an image: a stack of frames, channels first or last."""

    stack: tuple[int, ...]  # (S, a, b, c)
    channels_last: bool
    sure: bool = field(compare=False)  # True if the shape determines the axis of the channels

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return (C, H, W); the frames of a stack follow each other in C."""
        s, a, b, c = self.stack
        return (s * c, a, b) if self.channels_last else (s * a, b, c)

    def read(self, x: Tensor, lead: torch.Size) -> Tensor:
        """Rearrange images (*lead, *space.shape) to (*lead, C, H, W)."""
        frames = x.reshape(*lead, *self.stack)
        if self.channels_last:
            frames = frames.movedim(-1, -3)
        return frames.flatten(-4, -3)


def image_layout(space: gym.Space[Any]) -> ImageLayout | None:
    """Return the layout of a space that is an image, else None.

    Images are Boxes of 3 axes, or of 4 (a stack of frames), with bounds, and matrices of bytes. If
    the shape does not determine the axis of the channels, the layout is not ``sure``, and uses the
    shorter one of the outer axes.
    """
    if not isinstance(space, gym.spaces.Box):
        return None
    axes = len(space.shape)
    matrix = axes == 2 and space.dtype == np.uint8 and min(space.shape) >= _SMALLEST
    if not matrix and (axes not in (3, 4) or not _has_bounds(space)):
        return None
    stack = (1, 1, *space.shape)[-4:]
    if matrix:
        return ImageLayout(stack, False, True)
    last = _channels_last(*stack[1:])
    return ImageLayout(stack, stack[3] < stack[1] if last is None else last, last is not None)


def _has_bounds(space: gym.spaces.Box) -> bool:
    """Return whether the bounds of a Box are narrower than the data type's."""
    if not space.is_bounded():
        return False
    span = space.high.astype(np.float64) - space.low.astype(np.float64)
    return bool((span <= _WIDEST).all())


def _channels_last(a: int, b: int, c: int) -> bool | None:
    """Return whether images (a, b, c) have their channels last; None: the shape is ambiguous.

    With two equal axes, the third one holds the channels. With three different ones it is the
    shorter outer one, if it has few channels, or if the image is too large for a board.
    """
    if a == b != c:
        return True
    if b == c != a:
        return False
    if a == c:
        return None
    channels = min(a, c)
    longer = max(a, c)
    side = min(b, longer)
    if channels > 4:
        return c < a if side >= max(_PICTURE, 2 * channels) else None
    squarer = _aspect(b, channels) >= 1.5 * _aspect(b, longer)
    return c < a if squarer or side >= 2.5 * channels else None


def _aspect(a: int, b: int) -> float:
    return max(a, b) / max(1, min(a, b))


@dataclass(frozen=True)
class _Leaf:
    """An innermost part of an observation."""

    shape: tuple[int, ...]
    place: slice | None  # its bytes in an observation; None: it is the whole observation
    dtype: torch.dtype
    real: bool  # a Box, not choices
    choices: tuple[int, ...] = ()  # of each entry, if it becomes one-hot
    start: tuple[int, ...] = ()  # first choice of each entry
    image: ImageLayout | None = None
    bounds: tuple[Array, Array] | None = field(default=None, compare=False)  # of an image
    name: str = ""  # of the part: ``board``, ``pair.0``; "": it is the whole observation

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """Return the lowest and the highest number of each pixel, (C, H, W) float64."""
        assert self.image is not None
        assert self.bounds is not None
        ends = (torch.from_numpy(np.asarray(x, np.float64)) for x in self.bounds)
        low, high = (self.image.read(x, torch.Size()) for x in ends)
        return low, high

    def laid_out(self, planes: Literal["first", "last"]) -> _Leaf:
        """Return the leaf, an image, with its channels in the axis that ``planes`` names."""
        assert self.image is not None
        return replace(self, image=replace(self.image, channels_last=planes == "last", sure=True))

    @cached_property
    def size(self) -> int:
        return sum(self.choices) if self.choices else int(np.prod(self.shape))

    def read(self, obs: Tensor) -> Tensor:
        return obs if self.place is None else obs[..., self.place].view(self.dtype)

    def vector(self, x: Tensor, lead: torch.Size) -> Tensor:
        """Return a part of observations as floats for a network; choices are one-hot."""
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
    scaled: bool  # True if the vector has real numbers, which can be normalised
    item: tuple[int, ...]  # trailing shape of the tensors of ``to_tensor``
    leaves: tuple[_Leaf, ...]
    scales: tuple[PixelScale, ...] = field(compare=False)  # of each image
    unclear: tuple[str, ...] = ()
    """The images whose axis of channels neither the shape nor a setting determines."""
    is_one_vector: bool = False
    """The bytes of an observation are float32 numbers in the vector's order."""

    def split(self, obs: Tensor | Sequence[Tensor]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Split raw observations into a vector and images.

        Args:
            obs: (*lead, *item); or of each leaf, in order, (*lead, *its shape).

        Returns:
            The vector float32 (*lead, size); each image (*lead, C, H, W) in its own dtype.
        """
        if isinstance(obs, Tensor):
            if self.is_one_vector:
                return obs.view(torch.float32), ()
            lead = obs.shape[: obs.ndim - len(self.item)]
            raw: Sequence[Tensor] = [leaf.read(obs) for leaf in self.leaves]
        else:
            lead = obs[0].shape[: obs[0].ndim - len(self.leaves[0].shape)]
            raw = obs
        vectors = []
        images = []
        for leaf, x in zip(self.leaves, raw, strict=True):
            if leaf.image is None:
                vectors.append(leaf.vector(x, lead))
            else:
                images.append(leaf.image.read(x, lead))
        if len(vectors) == 1:
            return vectors[0], tuple(images)
        nothing = raw[0].new_empty((*lead, 0), dtype=torch.float32)
        return torch.cat(vectors, dim=-1) if vectors else nothing, tuple(images)

    def highest(self, i: int) -> Tensor:
        """Return the highest number of each pixel of image ``i``, (C, H, W), in its dtype."""
        leaf = [leaf for leaf in self.leaves if leaf.image is not None][i]
        assert leaf.image is not None
        assert leaf.bounds is not None
        return leaf.image.read(torch.from_numpy(leaf.bounds[1]), torch.Size())

    def pixels(self, image: Tensor, i: int) -> Tensor:
        """Convert image ``i`` for a network: float32, scaled to [0, 1] by its bounds."""
        return self.scales[i](image)


class PixelScale:
    """A scale of pixels to [0, 1] by the bounds of their space, which may differ between pixels.

    Args:
        low: the lowest number of each pixel, (C, H, W) float64.
        high: the highest one.
    """

    def __init__(self, low: Array, high: Array) -> None:
        span = np.where(high > low, high - low, 1.0)
        self._same = bool((low == low.flat[0]).all() and (span == span.flat[0]).all())
        self._low = float(low.flat[0])
        self._span = float(span.flat[0])
        self._each = {
            torch.device("cpu"): tuple(
                torch.from_numpy(np.asarray(x, np.float32)) for x in (low, span)
            )
        }
        """The lowest number and the span of each pixel, by device."""

    def __call__(self, image: Tensor) -> Tensor:
        """Scale pixels (…, C, H, W) of any type to float32."""
        x = image.float()
        if not self._same:
            low, span = self._on(image.device)
            return (x - low) / span
        if self._low != 0.0:
            x = x - self._low
        return x if self._span == 1.0 else x / self._span

    def _on(self, device: torch.device) -> tuple[Tensor, ...]:
        if device not in self._each:
            values = self._each[torch.device("cpu")]
            self._each[device] = tuple(x.to(device) for x in values)
        return self._each[device]


def obs_codec(space: gym.Space[Any], planes: Literal["first", "last"] | None = None) -> ObsCodec:
    """Return the codec of an observation space.

    Args:
        planes: the axis of the channels in images whose shape is ambiguous; if no shape is, in all
            images. None: only the shapes count.

    Raises:
        EnvError: the space is not supported; the message names supported ones.
    """
    dtype = obs_dtype(space)
    leaves = tuple(_leaf(part, path, dtype) for path, part in leaf_spaces(space).items())
    unclear = [leaf for leaf in leaves if leaf.image is not None and not leaf.image.sure]
    if planes is not None:
        again = unclear or [leaf for leaf in leaves if leaf.image is not None]
        leaves = tuple(leaf.laid_out(planes) if leaf in again else leaf for leaf in leaves)
        unclear = []
    vectors = [leaf for leaf in leaves if leaf.image is None]
    layouts = [leaf.image for leaf in leaves if leaf.image is not None]
    if not any(leaf.size for leaf in leaves):
        raise EnvError(f"the observation space {space} holds no number: nothing can be seen")
    check_size(space, "observation", sum(leaf.size for leaf in vectors))
    pixels = sum(leaf.size for leaf in leaves) - sum(leaf.size for leaf in vectors)
    check_size(space, "observation", pixels, 16 * LARGEST)
    item = obs_shape(space) if dtype.fields is None else (dtype.itemsize,)
    return ObsCodec(
        space=space,
        size=sum(leaf.size for leaf in vectors),
        images=tuple(layout.shape for layout in layouts),
        scaled=any(leaf.real for leaf in vectors),
        item=item,
        leaves=leaves,
        scales=tuple(
            PixelScale(*(x.numpy() for x in leaf.ends)) for leaf in leaves if leaf.image is not None
        ),
        unclear=tuple(_described(leaf) for leaf in unclear),
        is_one_vector=item == (_floats_without_gap(leaves),),
    )


def _floats_without_gap(leaves: Iterable[_Leaf]) -> int | None:
    """Return the bytes of leaves that are float32 numbers without gaps; None: they are not."""
    end = 0
    for leaf in leaves:
        plain = leaf.image is None and not leaf.choices and leaf.dtype == torch.float32
        if not plain or leaf.place is None or leaf.place.start != end:
            return None
        end = leaf.place.stop
    return end


def _described(leaf: _Leaf) -> str:
    """Return a leaf's name for messages: ``the observation's part board of shape (3, 3, 3)``."""
    what = f"the observation's part {leaf.name}" if leaf.name else "the observation"
    whole = f"{what} of shape {leaf.shape}"
    if len(leaf.shape) < 4:
        return whole
    return f"{whole}, by its first axis a stack of {leaf.shape[0]} frames {leaf.shape[1:]},"


def _leaf(space: Any, names: tuple[str, ...], dtype: np.dtype[Any]) -> _Leaf:
    """Return the leaf to which these names lead in observations of type ``dtype``."""
    offset = 0
    shape = obs_shape(space)
    place = None
    for name in names:
        assert dtype.fields is not None
        field, start_of = dtype.fields[name][:2]
        dtype = field.base
        offset = offset + start_of
    if names:
        place = slice(offset, offset + int(np.prod(shape)) * dtype.itemsize)
    choices, start = _choices(space)
    image = image_layout(space)
    return _Leaf(
        shape,
        place,
        torch.from_numpy(np.empty(0, dtype)).dtype,
        isinstance(space, gym.spaces.Box),
        choices,
        start,
        image,
        None if image is None else (space.low, space.high),
        ".".join(names),
    )


def _choices(space: gym.Space[Any]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the number of choices and the first choice of each entry; empty for numbers."""
    if isinstance(space, gym.spaces.Discrete):
        return (int(space.n),), (int(space.start),)
    if isinstance(space, gym.spaces.MultiDiscrete):
        start = np.broadcast_to(space.start, space.shape)
        return tuple(space.nvec.reshape(-1).tolist()), tuple(start.reshape(-1).tolist())
    return (), ()
