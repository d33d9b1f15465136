"""Notices of images whose bounds do not fit their values: networks scale images by their bounds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.notices import notice
from skillweave.spaces.observations import image_layout
from skillweave.spaces.packing import parts
from skillweave.types import Array

LOOKS = 64
"""Batches of observations that are looked at, from the first one on."""
ROWS = 4
"""Environments of a batch that are looked at."""
BEYOND = 0.5
"""How far values may lie beyond the bounds, as a share of their range."""
NARROW = 0.01
"""The share of the range that values must use."""


@dataclass
class _Image:
    """An image in observations, and the values that it had so far."""

    place: tuple[str, ...]  # names of the parts that lead to it
    low: Array  # (*shape) float64
    high: Array
    seen: list[float] = field(default_factory=lambda: [math.inf, -math.inf])  # least and largest
    scaled: list[float] = field(default_factory=lambda: [math.inf, -math.inf])
    """The same of the values scaled as for a network."""

    def see(self, obs: Array) -> None:
        """Look at some observations (n, *obs_shape)."""
        for name in self.place:
            obs = obs[name]
        values = obs[:ROWS].astype(np.float64)
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        for kept, array in ((self.seen, values), (self.scaled, (values - self.low) / span)):
            kept[:] = min(kept[0], float(array.min())), max(kept[1], float(array.max()))

    @property
    def is_beyond(self) -> bool:
        """Return whether values lie far beyond the bounds."""
        return self.scaled[0] < -BEYOND or self.scaled[1] > 1.0 + BEYOND

    @property
    def is_narrow(self) -> bool:
        """Return whether the values differ, and use a small part of the range."""
        return 0.0 < self.scaled[1] - self.scaled[0] <= NARROW


class ImageBounds:
    """Looks at an environment's first observations, and gives a notice where bounds do not fit.

    Args:
        name: what messages call the environment.
        space: of one observation.
    """

    def __init__(self, name: str, space: gym.Space[Any]) -> None:
        self._name, self._images, self._looks = name, list(_images_in(space)), LOOKS

    def see(self, obs: Array) -> bool:
        """Look at a batch of observations (n, *obs_shape); return whether to look at more."""
        if not len(obs):
            return True
        self._looks -= 1
        for image in list(self._images):
            image.see(obs)
            if image.is_beyond or (not self._looks and image.is_narrow):
                self._images.remove(image)
                self._tell(image)
        return self._looks > 0 and bool(self._images)

    def _tell(self, image: _Image) -> None:
        # Rounded: environments of training and of evaluations must give the same sentence.
        least, largest = image.seen
        if image.scaled[1] > 1.0 + BEYOND:
            unit = _unit(largest)
            has = f"values of {math.floor(largest / unit) * unit:g} and more"
            so = "lie far beyond 1"
        elif image.is_beyond:
            unit = _unit(least)
            has, so = f"values of {math.ceil(least / unit) * unit:g} and less", "lie far below 0"
        else:
            unit = _unit(largest - least)
            low, high = math.floor(least / unit) * unit, math.ceil(largest / unit) * unit
            has = f"its first {LOOKS} observations had values from {low:g} to {high:g} alone"
            so = "hardly differ"
        named = f" ({'.'.join(image.place)})" if image.place else ""
        notice(
            f"{self._name}: the observation{named} is an image with bounds from "
            f"{image.low.min():g} to {image.high.max():g}, but {has}. Networks get images scaled "
            f"to [0, 1] by their bounds, where these values {so}. Let observation_space have the "
            "bounds that the values have, or let the environment return values that fit its bounds"
        )


def _unit(value: float) -> float:
    """Return the unit of a number's first digit: 100 for 255."""
    return float(10.0 ** math.floor(math.log10(abs(value) or 1.0)))


def _images_in(space: gym.Space[Any], place: tuple[str, ...] = ()) -> Iterator[_Image]:
    inner = parts(space)
    if inner is not None:
        for name, part in inner.items():
            yield from _images_in(part, (*place, name))
    elif isinstance(space, gym.spaces.Box) and image_layout(space) is not None:
        yield _Image(place, space.low.astype(np.float64), space.high.astype(np.float64))
