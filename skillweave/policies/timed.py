"""Inputs of a model from elsewhere that come from time: clocks, tables, and their last values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .acting_errors import PolicyError
from .core import Array


@dataclass(eq=False)
class Clock:
    """Numbers that count the steps since a policy took over.

    Raises:
        PolicyError: its fields contradict each other.
    """

    first: Array
    """(K,), at the first step."""
    period: float | None = None
    """They start again at 0 after this number of steps; None: never."""
    wave: Literal["", "sin", "cos"] = ""
    """They are sines or cosines of the part of the period that has passed."""

    def __post_init__(self) -> None:
        if np.ndim(self.first) != 1 or not len(self.first):
            raise PolicyError(f"Clock.first has the shape {np.shape(self.first)}, not (numbers,)")
        if self.period is not None and not self.period > 0:
            raise PolicyError(f"Clock.period is {self.period}; it must be more than 0")
        if self.wave and self.period is None:
            raise PolicyError(f"Clock.wave is {self.wave!r}, but there is no Clock.period")

    @property
    def size(self) -> int:
        """The number of its numbers."""
        return len(self.first)

    def __call__(self, elapsed: Array) -> Array:
        """Return numbers (n, K) for steps (n,)."""
        x: Array = elapsed[:, None] + self.first
        if self.period is None:
            return x
        x = x % self.period
        if not self.wave:
            return x
        angle = 2.0 * np.pi / self.period * x
        return np.sin(angle) if self.wave == "sin" else np.cos(angle)


@dataclass(eq=False)
class Rows:
    """A row of a table for each step since a policy took over; its last row stays.

    Raises:
        PolicyError: its fields contradict each other.
    """

    numbers: Array
    """(T, K)."""
    rate: float = 1.0
    """Rows for each step; between two rows numbers are on the line between them."""
    first: float = 0.0
    """The row of the first step."""

    def __post_init__(self) -> None:
        if np.ndim(self.numbers) != 2 or not np.size(self.numbers):
            raise PolicyError(f"Rows.numbers has the shape {np.shape(self.numbers)}, not (T, K)")
        if not self.rate > 0 or not abs(self.first) < 2**31:
            raise PolicyError(f"Rows.rate is {self.rate} and Rows.first {self.first}")
        self._last = len(self.numbers) - 1

    @property
    def size(self) -> int:
        """The number of its numbers."""
        return int(self.numbers.shape[1])

    @property
    def steps(self) -> float:
        """The step at which its last row is reached."""
        return (self._last - self.first) / self.rate

    def __call__(self, elapsed: Array) -> Array:
        """Return numbers (n, K) for steps (n,)."""
        at = np.clip(self.first + self.rate * elapsed, 0.0, self._last)
        row = at.astype(np.int64)
        share = at - row
        x: Array = self.numbers[row]
        if not share.any():
            return x
        after: Array = self.numbers[np.minimum(row + 1, self._last)]
        between: Array = x + share[:, None] * (after - x)
        return between


@dataclass(eq=False)
class Past:
    """An input's numbers, those of this inference and of a few before it.

    Raises:
        PolicyError: its fields contradict each other.
    """

    ages: Array
    """(S,), for each number of the input how many inferences old it is."""
    columns: Array
    """(S,), and its place among the ``width`` numbers that are taken in each inference."""
    width: int
    zeros: tuple[int, ...] = ()
    """Places among these that were 0 before the first inference; the others had its value."""

    def __post_init__(self) -> None:
        ages, columns = np.asarray(self.ages), np.asarray(self.columns)
        whole = ages.dtype.kind in "iu" and columns.dtype.kind in "iu"
        if not whole or ages.ndim != 1 or ages.shape != columns.shape or not ages.size:
            raise PolicyError(
                f"Past.ages and Past.columns have the shapes {ages.shape} and {columns.shape}: "
                "they must be as many whole numbers"
            )
        places = [*columns.tolist(), *self.zeros]
        if min(places) < 0 or max(places) >= self.width or ages.min() < 0 or ages.max() > LONGEST:
            raise PolicyError(
                f"Past.columns, Past.zeros must be from 0 to {self.width - 1}, Past.ages to "
                f"{LONGEST:,}"
            )
        self.length = int(ages.max()) + 1
        """The number of inferences that are kept, this one included."""
        self._flat = ages.astype(np.int64) * self.width + columns
        self._zeros = np.array(self.zeros, np.int64)

    def __call__(self, kept: Array, known: Array, x: Array) -> Array:
        """Return the numbers (n, S), and put those of this inference first in ``kept``.

        Args:
            kept: (n, length, width), of the last inferences, the newest first.
            known: (n,) bool, there was one.
            x: (n, width), of this inference.
        """
        kept[:, 1:] = kept[:, :-1]
        kept[:, 0] = x
        if not known.all():
            first = np.flatnonzero(~known)
            before = x[first].astype(np.float64)
            before[:, self._zeros] = 0.0
            kept[first, 1:] = before[:, None]
        numbers: Array = np.take(kept.reshape(len(kept), -1), self._flat, axis=1)
        return numbers


LONGEST = 10_000
"""The most inferences that an input remembers."""
