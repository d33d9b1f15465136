"""Reading what may be damaged, or made by others: plain files, strict JSON, and a schema.

A schema is a type: a ``TypedDict`` for JSON that stays a dict, a dataclass for settings. ``fit``
compares what was read with it, and every error names the file and the field. This module does not
import torch.
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    NotRequired,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import numpy as np

from skillweave.errors import SkillweaveError
from skillweave.messages import short

DEEPEST = 100
"""How deep JSON may be nested; what reads it may then be recursive."""
LONGEST_TEXT = 4096
"""Characters of a text in JSON: the longest path that a system takes."""
LARGEST = 2**63
"""Whole numbers are smaller than this."""
LARGEST_FLOAT = 3.4e38
"""Other numbers are at most this: tensors of float32 must hold them."""
_SHOWN = 60


class Asked(NamedTuple):
    """A further demand on a field: ``Annotated[int, Asked("at least 1", lambda x: x >= 1)]``."""

    text: str
    holds: Callable[[Any], bool]


Positive = Annotated[int, Asked("at least 1", lambda x: x >= 1)]
"""A whole number of at least 1."""
Count = Annotated[int, Asked("at least 0", lambda x: x >= 0)]
"""A whole number of at least 0."""
Seconds = Annotated[float, Asked("at least 0", lambda x: x >= 0)]
"""A time."""


def shown(value: object, most: int = _SHOWN) -> str:
    """A value for a message: its ``repr``, shortened."""
    try:
        text = repr(value)
    except Exception:  # a number of too many digits, or nested too deep
        text = f"a {type(value).__name__}"
    return text if len(text) <= most else f"{text[: most - 1]}…"


# Files


def check_file(path: Path, most: int | None = None) -> None:
    """Raise a SkillweaveError where ``path`` is no plain file, or has more than ``most`` bytes.

    A pipe would wait for ever, and a device may never end.
    """
    try:
        found = os.stat(path)
    except FileNotFoundError as error:
        raise SkillweaveError(f"{path} does not exist") from error
    except (OSError, ValueError) as error:
        raise SkillweaveError(f"{path} cannot be read: {error}") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a directory" if stat.S_ISDIR(found.st_mode) else "a pipe or a device"
        raise SkillweaveError(f"{path} is {kind}, not a file")
    if most is not None and found.st_size > most:
        raise SkillweaveError(
            f"{path} has {found.st_size:,} bytes, but such a file has at most {most:,}: damaged, "
            "or another file"
        )


def read_file(path: Path, most: int | None = None) -> bytes:
    """The content of a plain file.

    Raises:
        SkillweaveError: it is missing, no plain file, too large, or cannot be read.
    """
    check_file(path, most)
    try:
        return path.read_bytes()
    except OSError as error:
        raise SkillweaveError(f"{path} cannot be read: {error.strerror or error}") from error


# JSON


def parse_json(text: str | bytes, where: Path | str) -> Any:
    """What a JSON text says; numbers are finite, and it is nested at most ``DEEPEST`` deep.

    Raises:
        SkillweaveError: it is damaged; the message begins with ``where``.
    """
    try:
        data = load_json(text, parse_constant=_finite, parse_float=_finite)
    except RecursionError as error:
        raise SkillweaveError(f"{where} is damaged: it is nested too deep") from error
    except ValueError as error:
        raise SkillweaveError(f"{where} is damaged: {str(error)[:300]}") from error
    layer, depth = [data], 0
    while layer:
        if depth > DEEPEST:
            raise SkillweaveError(f"{where} is damaged: it is nested too deep")
        layer, depth = [x for part in layer for x in _inside(part)], depth + 1
    return data


def as_json(value: Any, where: str, advice: str) -> Any:
    """Return a setting as plain JSON: NumPy's numbers as Python's, tuples as lists.

    Args:
        where: what messages call it; the places in it are added: ``kwargs['sizes'][0]``.
        advice: the end of messages, what to do.

    Raises:
        SkillweaveError: it holds something that is not the same after it was written and read.
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
    raise SkillweaveError(
        f"{where} is {short(value)}{keys}, but a run records only finite numbers, texts, and lists "
        f"and dicts of them; {advice}"
    )


def load_json(text: str | bytes, **how: Any) -> Any:
    """As ``json.loads``, but texts are of whole characters, as nothing else can be shown or saved.

    Raises:
        ValueError: it is no JSON, or holds a lone surrogate.
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
    """``data``, plain JSON, as a ``kind``: a type, or anything a field may be annotated with.

    A TypedDict stays a dict, and may have more fields than its type names. A dataclass is made,
    and may not; lists become tuples where it asks for them.

    Args:
        file: where it was read, for messages; "" where that is said elsewhere.
        path: the field in it: ``stages[0].algorithm``.

    Raises:
        SkillweaveError: a field is missing, unknown, of another type or out of range.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return data
    if origin is Annotated:
        value = fit(inner[0], data, file, path)
        for asked in inner[1:]:
            if not asked.holds(value):
                raise _wrong(data, asked.text, file, path)
        return value
    if origin in (Union, UnionType):
        if data is None and NoneType in inner:
            return None
        data_kinds = [k for k in inner if get_origin(k) is not Callable]
        if len(data_kinds) < len(inner) and isinstance(data, str):
            return fit(str, data, file, path)  # a function, recorded by its name
        options = [k for k in data_kinds if k is not NoneType]
        if is_dataclass(options[-1]):  # a plain value, or settings
            return fit(options[-1 if isinstance(data, Mapping) else 0], data, file, path)
        if len(options) == 1:
            return fit(options[0], data, file, path)
        words = get_args(options[1])
        if options[0] is not bool or get_origin(options[1]) is not Literal:
            raise TypeError(f"no schema: {kind!r}")
        if not isinstance(data, bool) and not (isinstance(data, str) and data in words):
            raise _wrong(data, f"true, false or {', '.join(words)}", file, path)
        return data
    if origin is Literal:
        if not isinstance(data, str) or data not in inner:
            raise _wrong(data, f"one of {', '.join(inner)}", file, path)
        return data
    if is_typeddict(kind) or is_dataclass(kind):
        return _record(kind, data, file, path)
    if origin in (list, tuple):
        return _sequence(origin, inner, data, file, path)
    if origin in (dict, Mapping):
        return {
            k: fit(inner[1], v, file, f"{path}[{shown(k)}]")
            for k, v in _object(data, file, path).items()
        }
    return _plain(kind, data, file, path)


def _plain(kind: Any, data: Any, file: str, path: str) -> Any:
    if kind is float:
        ok = type(data) in (int, float) and abs(data) <= LARGEST_FLOAT
        asked = "a finite number, of float32's range"
    elif kind is int:
        ok, asked = type(data) is int and abs(data) < LARGEST, "a whole number below 2^63"
    elif kind is str:
        ok = isinstance(data, str) and len(data) <= LONGEST_TEXT
        asked = f"a text of at most {LONGEST_TEXT} characters"
    elif kind is bool:
        ok, asked = isinstance(data, bool), "true or false"
    else:
        raise TypeError(f"no schema: {kind!r}")
    if not ok:
        raise _wrong(data, asked, file, path)
    return data


def _record(kind: Any, data: Any, file: str, path: str) -> Any:
    values, hints = dict(_object(data, file, path)), _hints(kind)
    made = is_dataclass(kind)
    needed = {f.name for f in fields(kind) if _needed(f)} if made else set(hints)
    for name, hint in hints.items():
        if name in values:
            inner = get_args(hint)[0] if get_origin(hint) is NotRequired else hint
            values[name] = fit(inner, values[name], file, f"{path}.{name}" if path else name)
        elif name in needed and get_origin(hint) is not NotRequired:
            what = f"{path} has no field {name!r}" if path else f"no field {name!r}"
            raise SkillweaveError(f"{file} is damaged: {what}" if file else what)
    if not made:
        return values
    if unknown := sorted(set(values) - set(hints)):
        raise SkillweaveError(
            f"{_at(file, path)} has no field {', '.join(u[:_SHOWN] for u in unknown[:3])}: made by "
            "a newer version?"
        )
    try:
        return kind(**values)
    except SkillweaveError as error:
        raise SkillweaveError(f"{_at(file, path)}: {error}" if file else str(error)) from error


def _needed(field: Any) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _sequence(origin: Any, inner: tuple[Any, ...], data: Any, file: str, path: str) -> Any:
    if not isinstance(data, list | tuple):
        raise _wrong(data, "a list", file, path)
    kinds = list(inner)
    if origin is list or inner[-1] is Ellipsis:
        kinds = [inner[0]] * len(data)
    elif len(data) != len(kinds):
        raise _wrong(data, f"a list of {len(kinds)}", file, path)
    return origin(
        fit(k, x, file, f"{path}[{i}]") for i, (k, x) in enumerate(zip(kinds, data, strict=True))
    )


def _object(data: Any, file: str, path: str) -> Mapping[str, Any]:
    if not isinstance(data, Mapping) or not all(isinstance(k, str) for k in data):
        raise _wrong(data, "an object, in braces", file, path)
    return data


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _at(file: str, path: str) -> str:
    return ": ".join(part for part in (file, path) if part)


def _wrong(value: Any, asked: str, file: str, path: str) -> SkillweaveError:
    where = _at(file, path) or "this"
    return SkillweaveError(f"{where} is {shown(value)}; it must be {asked}")
