"""Parts of messages on a batched info, for errors in code that reads infos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave.policies.infos import NUMBERS
from skillweave.types import Array


def info_keys(info: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys of a batched info that are text, without Gymnasium's masks (``_key``)."""
    texts = (key for key in info if isinstance(key, str))
    return tuple(key for key in texts if not (key.startswith("_") and key[1:] in info))


def missing_key(info: Mapping[str, Any]) -> str:
    """Return a clause on a key that no environment sets."""
    return (
        f"no environment set this key of info in this step (the keys are: {keys_of(info)}): let "
        "the environment set it in each step"
    )


def keys_of(info: Mapping[str, Any]) -> str:
    """Return the keys of a batched info, in words."""
    return ", ".join(short(key) for key in info_keys(info)) or "nothing"


def odd_key(function: Any, info: Mapping[str, Any], ids: Array | None = None) -> str:
    """Return a clause on a key that a function reads and that is not a number everywhere.

    Args:
        function: the user's function; it reads a key if the key is among its constants.
        ids: (n,) the environments; None: all n.

    Returns:
        An empty string if all its keys are numbers.
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
        values = (
            f"{short(column[row])} of environment {row if ids is None else int(ids[row])}"
            for row in rows
        )
        return (
            f"info[{key!r}] is {', but '.join(values)}: let the environment set a number there in "
            "each step"
        )
    return ""
