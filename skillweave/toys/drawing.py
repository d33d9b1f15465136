"""Shapes with smooth edges by NumPy alone, for pictures of any toy.

A shape is an array of signed distances: for each pixel the distance to the shape's edge, in the
world's units and negative inside. The union of two shapes is their ``np.minimum``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

Array: TypeAlias = np.ndarray[Any, np.dtype[Any]]
RGB: TypeAlias = tuple[int, int, int]
Point: TypeAlias = Sequence[float]


class Canvas:
    """A square picture of the world from −``extent`` to ``extent``, x to the right and y upwards.

    Args:
        pixels: width and height of the picture.
        extent: half the width of the world that it shows.
        color: of the background.
    """

    def __init__(self, pixels: int, extent: float, color: RGB) -> None:
        self.scale = pixels / (2 * extent)
        """Pixels of one unit of length."""
        middles = (np.arange(pixels) + 0.5) / self.scale - extent
        self._x = middles[None, :]
        self._y = -middles[:, None]
        self._picture = np.full((pixels, pixels, 3), color, np.float64)

    def copy(self) -> Canvas:
        """Return a canvas with the same picture, to draw on."""
        twin = object.__new__(Canvas)
        twin.scale = self.scale
        twin._x = self._x
        twin._y = self._y
        twin._picture = self._picture.copy()
        return twin

    def disc(self, middle: Point, radius: float) -> Array:
        """Return a disc."""
        distance: Array = np.hypot(self._x - middle[0], self._y - middle[1]) - radius
        return distance

    def ring(self, middle: Point, radius: float, width: float) -> Array:
        """Return a ring of this ``width`` around a circle of this ``radius``."""
        ring: Array = np.abs(self.disc(middle, radius)) - width / 2
        return ring

    def bar(self, start: Point, end: Point, width: float) -> Array:
        """Return a straight bar with round ends."""
        x, y = self._x - start[0], self._y - start[1]
        dx, dy = end[0] - start[0], end[1] - start[1]
        along = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        bar: Array = np.hypot(x - along * dx, y - along * dy) - width / 2
        return bar

    def box(self, low: Point, high: Point) -> Array:
        """Return a rectangle with the corners ``low`` and ``high``."""
        x = np.abs(self._x - (low[0] + high[0]) / 2) - (high[0] - low[0]) / 2
        y = np.abs(self._y - (low[1] + high[1]) / 2) - (high[1] - low[1]) / 2
        outside = np.hypot(np.maximum(x, 0.0), np.maximum(y, 0.0))
        box: Array = outside + np.minimum(np.maximum(x, y), 0.0)
        return box

    def paint(self, shape: Array, color: RGB, opacity: float = 1.0) -> None:
        """Fill a shape; a pixel on its edge gets a mixture of the colours."""
        cover = opacity * np.clip(0.5 - shape * self.scale, 0.0, 1.0)[..., None]
        self._picture += cover * (np.array(color) - self._picture)

    def frame(self) -> Array:
        """Return the picture, (pixels, pixels, 3) uint8."""
        return np.rint(self._picture).astype(np.uint8)
