"""Parts of sentences for people: values, errors and numbers in messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from skillweave.errors import DeclarationError, RunError
from skillweave.tracebacks import place

MOST = 10**12
"""The largest whole number that an argument may be: a million times it fits into 64 bits."""


def short(value: object, longest: int = 100) -> str:
    """Return ``repr(value)`` for a message, its middle left out where it is long."""
    try:
        text = repr(value)
    except Exception:
        text = f"a {type(value).__name__}"
    return shortened(text, longest)


def shortened(text: str, longest: int = 500) -> str:
    """Return text for a message, its middle left out where it is long."""
    half = longest // 2
    return text if len(text) <= longest else f"{text[:half]} … {text[-half:]}"


def close_matches(name: str, known: Iterable[str]) -> str:
    """Return a sentence after a space with up to four known names like ``name``; "" if none is."""
    near = difflib.get_close_matches(name, known, n=4, cutoff=0.6)
    return f" Close matches: {', '.join(near)}." if near else ""


def error_text(error: BaseException) -> str:
    """Return an error of the user's code for a sentence: its kind, message, file and line."""
    try:
        message = str(error)
    except Exception:
        message = ""
    text = type(error).__name__ + (f": {shortened(message)}" if message else "")
    where = place(error)
    return f"{text.removesuffix('.')} ({where})" if where else text


def whole_number(value: object, name: str, least: int) -> int:
    """Return ``value`` as an int.

    Raises:
        DeclarationError: it is no whole number, less than ``least``, or more than ``MOST``; the
            message begins with ``name``.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise DeclarationError(f"{name} is {short(value)}; it must be a whole number")
    if value < least:
        raise DeclarationError(f"{name} is {short(value)}; it must be at least {least}")
    if value > MOST:
        raise DeclarationError(f"{name} is {short(value)}; it must be at most {MOST:,}")
    return int(value)


def absolute(path: str | Path) -> Path:
    """Return the path from the root on, which leads to the same place from everywhere.

    Raises:
        RunError: the working directory, from which it leads, was deleted.
    """
    try:
        return Path(path).absolute()
    except OSError as error:
        raise RunError(
            f"{path} leads from the working directory, and that is not there any more: change to "
            "another directory, or give the path from the root on"
        ) from error


def shown_path(path: Path) -> Path:
    """Return a path for messages: from the working directory on where it is below that."""
    with suppress(OSError, ValueError):
        return path.relative_to(Path.cwd()) if path.is_absolute() else path
    return path


def as_path(path: str | Path, name: str) -> Path:
    """Return ``path`` as a ``Path``; an error names the argument where it is none."""
    if not isinstance(path, str | Path) or "\0" in str(path) or len(str(path)) > 4_096:
        raise DeclarationError(f"{name} is {short(path)}; it must be a path")
    return Path(path)
