"""Infos of environments, batched: a value of each environment in one array."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .core import Array

NUMBERS = bool | int | float | np.number | np.bool_


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
    """Return the values of n environments under one key as a column; ``rows`` have one."""
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
    """Return numbers as an array; None: no type represents all of them exactly."""
    array = np.array(values)
    if array.dtype.kind not in "biufc":
        return None  # whole numbers that are too large
    if mixed and array.dtype.kind == "f":
        same = (a == v or v != v for a, v in zip(array.tolist(), values, strict=True))
        return array if all(same) else None
    return array


def _stacked(values: list[Array]) -> Array | None:
    """Stack arrays; None: no array represents all of them exactly."""
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
