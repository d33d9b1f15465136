"""Batches as they are written: a row of all environments at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave.experience import Batch, column
from skillweave.types import Array


class BatchWriter:
    """Writes the rows of a batch, from the first to the last.

    A column exists from its first value on; what is not written has the column's ``fill``.

    Args:
        rows: T, the most there will be.
        num_envs: N.
    """

    def __init__(self, rows: int, num_envs: int) -> None:
        self._lead, self._columns = (rows, num_envs), dict[str, Array]()
        self.row = 0
        """The row that is written."""

    def write(self, ids: Array | None = None, **values: Array | None) -> None:
        """Write values of the row, (N, …); None: nothing.

        Args:
            ids: (k,) only in these environments; values are (k, …).
        """
        at: Any = self.row if ids is None else (self.row, ids)
        for name, value in values.items():
            if value is not None:
                self.column(name, value)[at] = value

    def column(self, name: str, like: Array) -> Array:
        """Return a column, (T, N, …), of the shape and type of ``like`` (k, …) if it is new."""
        values = self._columns.get(name)
        if values is None:
            shape, fill = (*self._lead, *like.shape[1:]), column(name).fill
            values = np.full(shape, fill, like.dtype) if fill else np.zeros(shape, like.dtype)
            self._columns[name] = values
        return values

    def get(self, name: str) -> Array | None:
        """Return a column, (T, N, …); None: it was not written."""
        return self._columns.get(name)

    def next(self) -> None:
        """Start the next row."""
        self.row += 1

    def batch(self, **more: Array | None) -> Batch:
        """Return what was written, each row of one step, with more columns; None removes one."""
        steps = np.ones(self._lead, np.int64)
        return Batch(**({"steps": steps} | self._columns | more))
