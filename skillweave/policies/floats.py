"""NumPy's handling of errors of floats: usual in the library, the program's own in its functions.

A program may set ``numpy.seterr(all="raise")`` to find its own errors. In the library an underflow
is a zero, as by default.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TypeVar

import numpy as np

C = TypeVar("C", bound=Callable[..., Any])
DEFAULT = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}
"""NumPy's own setting."""

_PROGRAM: ContextVar[dict[str, Any] | None] = ContextVar("_PROGRAM", default=None)
"""The program's own ``numpy.seterr``, where the library has replaced it; None: it has not."""


@contextmanager
def usual_floats() -> Iterator[None]:
    """Handle NumPy's float errors while policies act: as by default, or as the program ignores."""
    now: dict[str, Any] = dict(np.geterr())
    usual: dict[str, Any] = {kind: "ignore" if now[kind] == "ignore" else "warn" for kind in now}
    usual["under"] = "ignore"
    if usual == now:
        yield
        return
    before = _PROGRAM.set(now)
    try:
        with np.errstate(**usual):
            yield
    finally:
        _PROGRAM.reset(before)


def in_usual_floats(method: C) -> C:
    """Return a method that runs in ``usual_floats``; usually that costs little."""

    @wraps(method)
    def call(*args: Any, **named: Any) -> Any:
        if np.geterr() == DEFAULT:
            return method(*args, **named)
        with usual_floats():
            return method(*args, **named)

    return call  # type: ignore[return-value]


def by_program(function: Callable[..., Any], *args: Any, **named: Any) -> Any:
    """Return the result of a program's function in a policy, with the float handling it has set."""
    program = _PROGRAM.get()
    if program is None:
        return function(*args, **named)
    with np.errstate(**program):
        return function(*args, **named)
