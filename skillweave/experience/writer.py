"""Traces as they are written: a row of all environments at a time."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave.algorithms.batches import Trace, column
from skillweave.errors import EnvError
from skillweave.policies.core import Array
from skillweave.policies.infos import with_missing


class TraceWriter:
    """A writer of a trace, from the first row to the last.

    A column exists from its first value on; what is not written has the column's ``fill``.

    Args:
        rows: T, the most there will be.
        num_envs: N.
        keep_infos: keep the ``info`` of each step.
    """

    def __init__(self, rows: int, num_envs: int, *, keep_infos: bool = False) -> None:
        self._lead = (rows, num_envs)
        self._columns = dict[str, Array]()
        self._infos: list[Mapping[str, Any]] | None = [] if keep_infos else None
        self.row = 0
        """The row that is written."""

    def write(self, ids: Array | None = None, **values: Array | None) -> None:
        """Write values of the row, (N, …); None: nothing.

        Args:
            ids: (k,) only in these environments, ascending; values are (k, …).
        """
        every = ids is None or len(ids) == self._lead[1]  # several times as fast
        at: Any = self.row if every else (self.row, ids)
        for name, value in values.items():
            if value is not None:
                self._column(name, value)[at] = value

    def _column(self, name: str, like: Array) -> Array:
        """Return a column, (T, N, …), of the shape and type of ``like`` (k, …) if it is new."""
        values = self._columns.get(name)
        if values is None:
            shape = (*self._lead, *like.shape[1:])
            fill = column(name).fill
            values = np.full(shape, fill, like.dtype) if fill else np.zeros(shape, like.dtype)
            self._columns[name] = values
        return values

    def next(self, info: Mapping[str, Any]) -> None:
        """Start the next row; ``info`` is that of the row's step."""
        if self._infos is not None:
            self._infos.append(kept_info(info))
        self.row += 1

    def trace(self) -> Trace:
        """Return the rows written so far as a trace."""
        whole = self.row == self._lead[0]
        columns = {k: v if whole else v[: self.row] for k, v in self._columns.items()}
        return Trace(self._infos or (), columns)


def kept_info(info: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return an environment's info for the trace: objects are copied, as they may change."""
    if all(isinstance(v, np.ndarray) and v.dtype != object for v in info.values()):
        return info
    kept = {key: _copied(value, key) for key, value in info.items()}
    return with_missing(kept, info, getattr(info, "n", 0))


def _copied(value: Any, key: str) -> Any:
    """Return a value of an ``info`` in a trace as a copy, as environments may change it."""
    if isinstance(value, np.ndarray) and value.dtype != object:
        return value
    if isinstance(value, dict):
        return kept_info(value)
    try:
        return copy.deepcopy(value)
    except Exception:
        return _Uncopied(key)


class _Uncopied:
    """Stands for a value of ``info`` that a skill cannot be shown after its step."""

    def __init__(self, key: str) -> None:
        self._key = key

    def _refuse(self, *_: Any) -> Any:
        raise EnvError(
            f"info[{self._key!r}] holds an object that cannot be copied, and rewards are computed "
            "after the steps of a round: let the environment set numbers or arrays there"
        )

    __getitem__ = _refuse  # iteration uses it, too
    __getattr__ = _refuse  # so does NumPy, which looks for ``__array__``
