"""Words on a batched info, for errors of code that reads infos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave.messages import short
from skillweave.types import Array

NUMBERS = bool | int | float | np.number | np.bool_


def info_keys(info: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys of a batched info that are text, without Gymnasium's masks (``_key``)."""
    texts = (key for key in info if isinstance(key, str))
    return tuple(key for key in texts if not (key.startswith("_") and key[1:] in info))


def keys_told(info: Mapping[str, Any]) -> str:
    """Words on a key that no environment gives."""
    return (
        f"no environment gave this key of info in this step (they gave {keys_of(info)}): let the "
        "environment give it in each step"
    )


def keys_of(info: Mapping[str, Any]) -> str:
    """Return the keys of a batched info, in words."""
    return ", ".join(short(key) for key in info_keys(info)) or "nothing"


def odd_key(function: Any, info: Mapping[str, Any], ids: Array | None = None) -> str:
    """Words on a key, read by a function, under which not all environments give a number.

    Args:
        function: the user's; a key is taken to be read if it is among its constants.
        ids: (n,) the environments; None: all n.

    Returns:
        An empty string where there is no such key.
    """
    code = getattr(getattr(function, "__func__", function), "__code__", None)
    for key in getattr(code, "co_consts", ()):
        column = info.get(key) if isinstance(key, str) else None
        if isinstance(column, dict):
            return f"info[{key!r}] is a dict of {keys_of(column)}: read one of these"
        if not isinstance(column, np.ndarray) or column.dtype != object or column.ndim != 1:
            continue
        number = [isinstance(value, NUMBERS) for value in column]
        if all(number):
            continue
        rows = [number.index(True)] if any(number) else []
        rows.append(number.index(False))
        told = (
            f"{short(column[row])} of environment {row if ids is None else int(ids[row])}"
            for row in rows
        )
        return (
            f"info[{key!r}] is {', but '.join(told)}: let the environment give a number there in "
            "each step"
        )
    return ""
