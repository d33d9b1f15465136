"""Files that may be damaged or made by others: plain files, and strict JSON."""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
from pathlib import Path
from typing import Any

from .acting_errors import RunError

DEEPEST = 100
"""The deepest nesting of JSON, so that its readers may be recursive."""
_SHOWN = 60


def shown(value: object, most: int = _SHOWN) -> str:
    """Return a value for a message about a file from others: its ``repr``, shortened."""
    try:
        text = repr(value)
    except Exception:  # a number of too many digits, or nested too deep
        text = f"a {type(value).__name__}"
    return shown_text(text, most)


def shown_text(text: str, most: int = _SHOWN) -> str:
    """Return a text for a message, shortened."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


# Files


def checksum(content: bytes) -> str:
    """Compute the SHA-256 as hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def check_file(path: Path, most: int | None = None) -> None:
    """Raise a RunError where a file from others is not plain, or has more than ``most`` bytes.

    A pipe would wait forever, and a device may never end.
    """
    try:
        found = os.stat(path)
    except FileNotFoundError as error:
        raise RunError(f"{path} does not exist") from error
    except (OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a directory" if stat.S_ISDIR(found.st_mode) else "a pipe or a device"
        raise RunError(f"{path} is {kind}, not a file")
    if most is not None and found.st_size > most:
        raise RunError(
            f"{path} has {found.st_size:,} bytes, but such a file has at most {most:,}: damaged, "
            "or another file"
        )


def read_file(path: Path, most: int | None = None) -> bytes:
    """Return the content of a plain file, which may be damaged or hostile, up to a bound.

    Raises:
        RunError: it is missing, no plain file, too large, or cannot be read.
    """
    check_file(path, most)
    try:
        return path.read_bytes()
    except OSError as error:
        raise RunError(f"{path} cannot be read: {error.strerror or error}") from error


# JSON


def parse_json(text: str | bytes, where: Path | str) -> Any:
    """Parse a JSON text from others: finite numbers, nested at most ``DEEPEST`` deep.

    Raises:
        RunError: it is damaged; the message begins with ``where``.
    """
    try:
        data = load_json(text, parse_constant=_finite, parse_float=_finite)
    except RecursionError as error:
        raise RunError(f"{where} is damaged: it is nested too deep") from error
    except ValueError as error:
        raise RunError(f"{where} is damaged: {str(error)[:300]}") from error
    layer = [data]
    depth = 0
    while layer:
        if depth > DEEPEST:
            raise RunError(f"{where} is damaged: it is nested too deep")
        layer = [x for part in layer for x in _inside(part)]
        depth += 1
    return data


def load_json(text: str | bytes, **how: Any) -> Any:
    """Load JSON from others as ``json.loads`` does, without lone surrogates.

    Raises:
        ValueError: it is not JSON, or holds a lone surrogate.
    """
    data = json.loads(text, **how)
    escape: Any = "\\" if isinstance(text, str) else b"\\"
    if escape in text or not text.isascii():
        try:
            json.dumps(data, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            raise ValueError("a text in it holds half of a character") from error
    return data


def _inside(data: Any) -> Any:
    if isinstance(data, dict):
        return data.values()
    return data if isinstance(data, list) else ()


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{shown(text)} is no finite number")
    return value
