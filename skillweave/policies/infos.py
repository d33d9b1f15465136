"""Infos of environments, batched: a value of each environment in one array."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

NUMBERS = bool | int | float | np.number | np.bool_
LATE = 1_000
"""Steps after which a key that is asked for, and that no environment has given, is refused."""


class Infos(dict[str, Any]):
    """A batched info of n environments: ``infos[key]`` of a key that none gives now is 0 or None.

    ``in``, ``get`` and iteration see only what the environments give in this step.

    Args:
        info: the batched values of this step, without missing ones.
        keys: those that they have given so far.
        n: their number.
    """

    __slots__ = ("keys_so_far", "n")

    def __init__(self, info: Mapping[str, Any], keys: InfoKeys, n: int) -> None:
        super().__init__(info)
        self.keys_so_far = keys
        self.n = n

    def __missing__(self, key: str) -> Any:
        return self.keys_so_far.missing(key, self.n)


def with_missing(part: dict[str, Any], info: Mapping[str, Any], n: int) -> dict[str, Any]:
    """Return a part of a batched info, of n rows, in which the same is missing as in ``info``."""
    keys = getattr(info, "keys_so_far", None)
    return part if keys is None else Infos(part, keys, n)


class InfoKeys:
    """The keys that some environments have given in their infos so far.

    A key that is asked for before any environment has given it may come later, so it is 0 until an
    episode has ended and ``LATE`` steps are over.
    """

    def __init__(self) -> None:
        self.examples: dict[str, Any] = {}
        """By key, the first column; of a dict its own ``InfoKeys``."""
        self.asked: set[str] = set()
        """Keys that were asked for, and that no environment has given."""
        self._steps, self._ended = 0, False

    def see(self, info: Mapping[str, Any], n: int, *, ended: bool = False) -> Infos:
        """Return the batched info of a step of n environments, with what is missing in it.

        Args:
            ended: an episode ended in this step.
        """
        self._steps += n
        self._ended |= ended
        found = Infos(info, self, n)
        if not info.keys() <= self.examples.keys():
            for key in info.keys() - self.examples.keys():
                value = info[key]
                self.examples[key] = InfoKeys() if isinstance(value, dict) else value
            self.asked -= self.examples.keys()
        for key, value in info.items():
            if isinstance(value, dict) and isinstance(inner := self.examples[key], InfoKeys):
                found[key] = inner.see(value, n, ended=ended)
        return found

    def missing(self, key: str, n: int) -> Any:
        """Return the column of a key that no environment gives in a step.

        Raises:
            KeyError: no environment has given it in a long time.
        """
        if key in self.examples:
            example = self.examples[key]
            if isinstance(example, InfoKeys):
                return Infos({}, example, n)
            if not isinstance(example, np.ndarray) or example.dtype == object:
                return np.full(n, None, object)
            return np.zeros((n, *example.shape[1:]), example.dtype)
        if not isinstance(key, str) or (self._ended and self._steps >= LATE):
            self.asked.discard(key)
            raise KeyError(key)
        if key.startswith("_"):
            return np.zeros(n, bool)
        self.asked.add(key)
        return np.zeros(n)


def one_number(value: Any) -> float | None:
    """Return the only number in a value of an info: alone or in an array; None: it has none.

    None and a NaN are the number that is not known, NaN.
    """
    while isinstance(value, list | tuple) and len(value) == 1:
        value = value[0]
    if callable(item := getattr(value, "item", None)):  # an array's, a tensor's
        with suppress(Exception):
            value = item()
    if value is None:
        return np.nan
    if not isinstance(value, NUMBERS) or isinstance(value, np.complexfloating):
        return None
    return float(value)


def batched_infos(infos: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Batch the infos of n environments in the format of Gymnasium's vectors.

    Gymnasium casts the values of all environments to the type of the first, 0.5 to 0 for example.
    Here an array has a type that represents all of them exactly.

    Returns:
        By key, an array over the n environments: of numbers; of arrays of one shape; else of
        objects. Dicts are batched in turn. Where an environment's info lacks the key, the value is
        0, or None among objects, and the (n,) bool under ``_key`` is False.
    """
    if not any(infos):
        return {}
    n = len(infos)
    columns: dict[str, tuple[list[int], list[Any]]] = {}
    for row, info in enumerate(infos):
        for key, value in info.items():
            rows, values = columns.setdefault(key, ([], []))
            rows.append(row)
            values.append(value)
    batch: dict[str, Any] = {}
    for key, (rows, values) in columns.items():
        batch[key] = _column(rows, values, n)
        if (mask := f"_{key}") not in columns:
            present = np.zeros(n, bool)
            present[rows] = True
            batch[mask] = present
    return batch


def _column(rows: list[int], values: list[Any], n: int) -> Any:
    """Return the values of n environments under one key of their infos; ``rows`` have one."""
    kinds = set(map(type, values))
    if all(issubclass(kind, dict) for kind in kinds):
        inner: list[dict[str, Any]] = [{}] * n
        for row, value in zip(rows, values, strict=True):
            inner[row] = value
        return batched_infos(inner)
    array = None
    if all(issubclass(kind, NUMBERS) for kind in kinds):
        array = _numbers(values, mixed=len(kinds) > 1 or int in kinds)
    elif all(issubclass(kind, np.ndarray) for kind in kinds):
        array = _stacked(values)
    if array is not None:
        if len(rows) == n:
            return array
        column = np.zeros((n, *array.shape[1:]), array.dtype)
        column[rows] = array
        return column
    objects = np.full(n, None, object)
    for row, value in zip(rows, values, strict=True):
        objects[row] = value
    return objects


def _numbers(values: list[Any], *, mixed: bool) -> Array | None:
    """Return numbers of infos as an array; None: no type represents all of them exactly."""
    array = np.array(values)
    if array.dtype.kind not in "biufc":
        return None  # whole numbers that are too large
    if mixed and array.dtype.kind == "f":
        same = (a == v or v != v for a, v in zip(array.tolist(), values, strict=True))
        return array if all(same) else None
    return array


def _stacked(values: list[Array]) -> Array | None:
    """Stack arrays of infos; None: no array represents all of them exactly."""
    first = values[0]
    if any(v.shape != first.shape for v in values):
        return None
    try:
        stacked = np.stack(values)
    except TypeError:  # dates and numbers, for example
        return None
    if any(v.dtype != stacked.dtype for v in values):
        same = all(
            np.array_equal(a, v, equal_nan=v.dtype.kind == "f")
            for a, v in zip(stacked, values, strict=True)
        )
        return stacked if same else None
    return stacked
