"""Notices of images whose bounds do not fit their values, because networks scale by the bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.notices import notice
from skillweave.policies.core import Array
from skillweave.policies.spaces import at
from skillweave.spaces.observations import image_layout
from skillweave.spaces.packing import leaf_spaces

LOOKS = 64
"""The first batches of observations, which are checked."""
ROWS = 4
"""The environments of a batch that are checked."""
BEYOND = 0.5
"""The largest excess of values beyond the bounds, as a share of the range."""
NARROW = 0.01
"""The least share of the range that values must use."""


@dataclass
class _Image:
    """An image in observations, and the range of its values so far."""

    place: tuple[str, ...]  # names of the parts that lead to it
    low: Array  # (*shape) float64
    high: Array
    seen: list[float] = field(default_factory=lambda: [math.inf, -math.inf])  # least and largest
    scaled: list[float] = field(default_factory=lambda: [math.inf, -math.inf])
    """Least and largest of the values scaled as for a network."""

    def see(self, obs: Array) -> None:
        """Update the ranges with observations (n, *obs_shape)."""
        values = at(obs, self.place)[:ROWS].astype(np.float64)
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        for limits, array in ((self.seen, values), (self.scaled, (values - self.low) / span)):
            limits[:] = min(limits[0], float(array.min())), max(limits[1], float(array.max()))

    @property
    def is_beyond(self) -> bool:
        """Return whether values lie far beyond the bounds."""
        return self.scaled[0] < -BEYOND or self.scaled[1] > 1.0 + BEYOND


class ImageBounds:
    """A check of an environment's first observations that gives a notice where bounds do not fit.

    Args:
        name: the environment's name in messages.
        space: the space of one observation.
    """

    def __init__(self, name: str, space: gym.Space[Any]) -> None:
        self._name = name
        self._images = [
            _Image(place, leaf.low.astype(np.float64), leaf.high.astype(np.float64))
            for place, leaf in leaf_spaces(space).items()
            if image_layout(leaf) is not None
        ]
        self._looks = LOOKS

    def see(self, obs: Array) -> bool:
        """Check a batch of observations (n, *obs_shape); return whether to check more."""
        if not len(obs):
            return True
        self._looks -= 1
        for image in list(self._images):
            image.see(obs)
            is_narrow = 0.0 < image.scaled[1] - image.scaled[0] <= NARROW
            if image.is_beyond or (not self._looks and is_narrow):
                self._images.remove(image)
                self._notice(image)
        return self._looks > 0 and bool(self._images)

    def _notice(self, image: _Image) -> None:
        """Give a notice of an image whose values do not fit the bounds of its space."""
        # Rounded, so environments of training and of evaluations give the same sentence.
        least, largest = image.seen
        if image.scaled[1] > 1.0 + BEYOND:
            unit = _unit(largest)
            has = f"values of {math.floor(largest / unit) * unit:g} and more"
            so = "lie far beyond 1"
        elif image.is_beyond:
            unit = _unit(least)
            has = f"values of {math.ceil(least / unit) * unit:g} and less"
            so = "lie far below 0"
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
