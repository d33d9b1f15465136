"""A ring of rows that grows: what only some transitions of a replay buffer have."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from skillweave.types import Array


class Ring:
    """Rows are numbered as they come, and leave in the same order; ``row_shape`` of each.

    Numbers count modulo 2^32. ``last`` is the next one, ``first`` the oldest that is still kept.
    """

    def __init__(self, row_shape: tuple[int, ...], dtype: DTypeLike, length: int = 64) -> None:
        self.first = self.last = 0
        self.rows: Array = np.zeros((length, *row_shape), dtype)  # a power of two

    def put(self, rows: Array) -> Array:
        """Keep ``rows`` (k, …); their numbers (k,) int32."""
        new = np.arange(self.last, self.last + len(rows))
        self.last += len(rows)
        if len(self.rows) < (needed := self.last - self.first):
            live = np.arange(self.first, new[0])
            grown = np.zeros(
                (1 << (needed - 1).bit_length(), *self.rows.shape[1:]), self.rows.dtype
            )
            grown[live & len(grown) - 1] = self.rows[live & len(self.rows) - 1]
            self.rows = grown
        self.rows[new & len(self.rows) - 1] = rows
        return new.astype(np.int32)

    def drop(self, count: int) -> None:
        """Forget the oldest ``count`` rows."""
        self.first += count

    def take(self, numbers: Array) -> Array:
        """The rows of ``numbers``, of any shape."""
        found: Array = self.rows[numbers & len(self.rows) - 1]
        return found
