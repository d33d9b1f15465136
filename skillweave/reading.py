"""Reading of files that may be damaged or made by others: a schema.

A schema is a type: a ``TypedDict`` for JSON that stays a dict, a dataclass for settings. ``fit``
compares data with it, and every error names the file and the field. ``settings`` has the kinds of
annotations. This module does not import torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, NotRequired, get_args, get_origin, is_typeddict

import numpy as np

from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.messages import short
from skillweave.policies.files import (
    check_file as check_file,
    load_json as load_json,
    parse_json as parse_json,
    read_file as read_file,
    shown as shown,
)
from skillweave.settings import Fitting, Unfit, annotations_of

# JSON


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
                f"{_at(file, path)} has no field {', '.join(u[:60] for u in unknown[:3])}: "
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
