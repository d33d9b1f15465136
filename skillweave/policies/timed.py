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
        if not (np.abs(self.first) < MOST).all():
            raise PolicyError(f"Clock.first is beyond {MOST:,}, or NaN")
        if self.period is not None and not 1 / MOST < self.period < MOST:
            raise PolicyError(
                f"Clock.period is {self.period}; it must be from 1/{MOST:,} to {MOST:,}"
            )
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
        # The rest of a step that ends a period, 56 of 56.00000000000001, is 0 and not the period.
        turns = x / self.period
        whole = np.rint(turns)
        ends = np.abs(turns - whole) < CLOSE * np.maximum(1.0, np.abs(whole))
        x = np.where(ends, 0.0, x % self.period)
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
        if not 0 < self.rate < MOST or not abs(self.first) < MOST:
            raise PolicyError(
                f"Rows.rate is {self.rate} and Rows.first {self.first}; they must be less than "
                f"{MOST:,}, and the rate more than 0"
            )
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
        self.length = int(ages.max())
        """The number of inferences before this one that are kept."""
        old = ages > 0
        columns = columns.astype(np.int64)
        self.kept = np.unique(columns[old])
        """The places of the numbers that are kept of each."""
        self._old, self._now = np.flatnonzero(old), np.flatnonzero(~old)
        self._columns = columns[self._now]
        place = np.searchsorted(self.kept, columns[old])
        self._flat = (ages[old].astype(np.int64) - 1) * len(self.kept) + place
        self._zeros = np.isin(self.kept, self.zeros)

    def __call__(self, kept: Array, known: Array, x: Array) -> Array:
        """Return the numbers (n, S), and put those of this inference first in ``kept``.

        Args:
            kept: (n, length, numbers), of the inferences before, the newest first.
            known: (n,) bool, there was one.
            x: (n, width), of this inference.
        """
        mine = x[:, self.kept]
        if not known.all():
            first = np.flatnonzero(~known)
            kept[first] = np.where(self._zeros, 0.0, mine[first])[:, None]
        numbers: Array = np.empty((len(x), len(self._old) + len(self._now)))
        numbers[:, self._now] = x[:, self._columns]
        numbers[:, self._old] = kept.reshape(len(kept), -1)[:, self._flat]
        kept[:, 1:] = kept[:, :-1]
        kept[:, :1] = mine[:, None]
        return numbers


LONGEST = 10_000
"""The most inferences that an input remembers."""
MOST = 2**31
"""Steps, rows and periods are less than this."""
CLOSE = 1e-9
"""The relative difference of steps and periods that is rounding."""
