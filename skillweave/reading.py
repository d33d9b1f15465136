"""Reading of files that may be damaged or made by others: plain files, strict JSON, a schema.

A schema is a type: a ``TypedDict`` for JSON that stays a dict, a dataclass for settings. ``fit``
compares data with it, and every error names the file and the field. ``settings`` has the kinds of
annotations. This module does not import torch.
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, NotRequired, get_args, get_origin, is_typeddict

import numpy as np

from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.messages import short
from skillweave.settings import Fitting, Unfit, annotations_of

DEEPEST = 100
"""The deepest nesting of JSON, so that its readers may be recursive."""
_SHOWN = 60


def shown(value: object, most: int = _SHOWN) -> str:
    """Return a value for a message: its ``repr``, shortened."""
    try:
        text = repr(value)
    except Exception:  # a number of too many digits, or nested too deep
        text = f"a {type(value).__name__}"
    return text if len(text) <= most else f"{text[: most - 1]}…"


# Files


def check_file(path: Path, most: int | None = None) -> None:
    """Raise a RunError where ``path`` is not a plain file, or has more than ``most`` bytes.

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
    """Return the content of a plain file.

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
    """Parse a JSON text whose numbers are finite and that is nested at most ``DEEPEST`` deep.

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


def as_json(value: Any, where: str, advice: str) -> Any:
    """Convert a setting to plain JSON: NumPy's numbers to Python's, tuples to lists.

    Args:
        where: its name in messages, to which places are added: ``kwargs['sizes'][0]``.
        advice: the end of messages, what to do.

    Raises:
        DeclarationError: it holds a value that writing and reading would change.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    if isinstance(value, list | tuple):
        return [as_json(x, f"{where}[{i}]", advice) for i, x in enumerate(value)]
    if isinstance(value, Mapping) and all(isinstance(k, str) for k in value):
        return {k: as_json(x, f"{where}[{k!r}]", advice) for k, x in value.items()}
    keys = " with keys that are no text" if isinstance(value, Mapping) else ""
    raise DeclarationError(
        f"{where} is {short(value)}{keys}, but a run records only finite numbers, texts, and lists "
        f"and dicts of them; {advice}"
    )


def load_json(text: str | bytes, **how: Any) -> Any:
    """Load JSON as ``json.loads`` does, without lone surrogates, which cannot be shown or saved.

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


# The schema


def fit(kind: Any, data: Any, file: str, path: str = "") -> Any:
    """Convert ``data``, plain JSON, to a ``kind``: a type, or any annotation of a field.

    A TypedDict stays a dict, and may have further fields. A dataclass is created, and may not have
    further fields; lists become tuples where it needs them.

    Args:
        file: the file that it is from, for messages; "" if the caller names it.
        path: the field in it: ``stages[0].algorithm``.

    Raises:
        RunError: a field is missing, unknown, of another type or out of range.
    """
    try:
        return _FileFitting(file).fit(kind, data, path)
    except Unfit as error:
        where = _at(file, error.path) or "this"
        raise RunError(f"{where} is {shown(error.value)}; it must be {error.text}") from None


class _FileFitting(Fitting):
    """A converter of JSON to a schema, field by field, so that errors name the field."""

    yes_and_no = "true", "false"
    mapping = "an object, in braces"

    def __init__(self, file: str) -> None:
        self.file = file

    def accepts_other(self, kind: Any, value: Any) -> bool:
        """Return whether a value is of a kind that is a record."""
        if kind is Any:
            return True
        if not is_typeddict(kind) and not is_dataclass(kind):
            raise TypeError(f"no schema: {kind!r}")
        return isinstance(value, Mapping) and all(isinstance(k, str) for k in value)

    def describe_other(self, kind: Any) -> str:
        """Return the name of a record in JSON."""
        return self.mapping

    def record(self, kind: Any, value: Any, path: str) -> Any:
        """Convert a dict to a TypedDict or to settings, each field fitted.

        Raises:
            RunError: a field is missing or unknown, or the fields do not fit each other.
        """
        values = dict(value)
        hints = annotations_of(kind)
        file = self.file
        made = is_dataclass(kind)
        names = {f.name for f in fields(kind)} if made else set(hints)
        needed = {f.name for f in fields(kind) if _needed(f)} if made else names
        for name, hint in hints.items():
            if name in values:
                inner = get_args(hint)[0] if get_origin(hint) is NotRequired else hint
                values[name] = self.fit(inner, values[name], f"{path}.{name}" if path else name)
            elif name in needed and get_origin(hint) is not NotRequired:
                what = f"{path} has no field {name!r}" if path else f"no field {name!r}"
                raise RunError(f"{file} is damaged: {what}" if file else what)
        if not made:
            return values
        if unknown := sorted(set(values) - names):
            raise RunError(
                f"{_at(file, path)} has no field {', '.join(u[:_SHOWN] for u in unknown[:3])}: "
                "made by a newer version?"
            )
        try:
            return kind(**values)
        except SkillweaveError as error:
            raise RunError(f"{_at(file, path)}: {error}" if file else str(error)) from error


def _needed(field: Any) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _at(file: str, path: str) -> str:
    return ": ".join(part for part in (file, path) if part)
