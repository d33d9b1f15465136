"""The one schema: annotations of fields are their checks, of settings, of files, and of ``--set``.

``gamma: Fraction = 0.99`` says that γ lies between 0 and 1. ``@settings`` above a dataclass
checks every field by its annotation when an object is made. ``fit`` compares files with the same
annotations, or with a ``TypedDict`` for JSON that stays a dict; ``to_json`` writes what it reads.
This module does not import torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    NotRequired,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short, suggest
from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.policies.untrusted import shown

C = TypeVar("C", bound=type[Any])

LARGEST = 2**63
"""The limit of whole numbers, which arrays of int64 must represent."""
LARGEST_FLOAT = 3.4e38
"""The limit of other numbers, which tensors of float32 must represent."""
LONGEST_TEXT = 4096
"""The most characters of a text: the longest path that a system accepts."""


# Kinds of values


class Check(NamedTuple):
    """A condition on a field: ``Annotated[int, Check("at least 1", lambda x: x >= 1)]``.

    Beside numbers the text continues "a whole number". Beside any other type it replaces the
    description of the type. ``convert`` first brings other forms of a value into one of this
    kind; it raises an error where it cannot.
    """

    text: str
    holds: Callable[[Any], bool] = lambda _: True
    convert: Callable[[Any], Any] = lambda x: x


AtLeastOne = Annotated[int, Check("at least 1", lambda x: x >= 1)]
"""A whole number of at least 1."""
Count = Annotated[int, Check("at least 0", lambda x: x >= 0)]
"""A whole number of at least 0."""
Amount = Annotated[int, Check("at least 1 and at most 1,000,000", lambda x: 1 <= x <= 1_000_000)]
"""A whole number of at least 1, of what takes memory or time each."""
Threads = Annotated[int, Check("at least 1 and at most 1,024", lambda x: 1 <= x <= 1024)]
"""A number of threads or processes."""
Positive = Annotated[float, Check("positive and finite", lambda x: x > 0)]
"""A number above 0."""
NonNegative = Annotated[float, Check("at least 0 and finite", lambda x: x >= 0)]
"""A number of at least 0."""
Fraction = Annotated[float, Check("between 0 and 1", lambda x: 0 <= x <= 1)]
"""A number from 0 to 1."""
Share = Annotated[float, Check("more than 0 and at most 1", lambda x: 0 < x <= 1)]
"""A number from 0 to 1, without 0."""
RECORDED = "recorded by its name"
"""Beside a kind of function: also accept the name under which files record the function."""
_FINITE = "a finite number"


# Fitting a value to a kind


def fitted(kind: Any, value: Any, where: str) -> Any:
    """Return a setting in its plainest form.

    Lists become tuples and dicts become settings where the kind needs them; NumPy's numbers
    become Python's.

    Args:
        kind: its annotation.
        value: the given value.
        where: the setting, for messages: ``PPO.gamma``.

    Raises:
        DeclarationError: it does not fit.
    """
    try:
        return _Fitting().fit(kind, value, where)
    except _Unfit as error:
        raise DeclarationError(str(error)) from None


def fit(kind: Any, data: Any, file: str, path: str = "") -> Any:
    """Convert ``data``, plain JSON, to a ``kind``: a type, or any annotation of a field.

    A TypedDict stays a dict, and may have further fields. A dataclass is created, and may not have
    further fields; lists become tuples where it needs them.

    Args:
        kind: what it must be.
        data: the data that were read.
        file: the file that it is from, for messages; "" if the caller names it.
        path: the field in it: ``stages[0].algorithm``.

    Raises:
        RunError: a field is missing, unknown, of another type or out of range.
    """
    try:
        return _Fitting(file).fit(kind, data, path)
    except _Unfit as error:
        where = _at(file, error.path) or "this"
        raise RunError(f"{where} is {shown(error.value)}; it must be {error.text}") from None


def described(kind: Any) -> str:
    """Return a description of valid settings: "a whole number, at least 1, or None"."""
    return _Fitting().describe(kind)


class _Unfit(Exception):
    """A value does not fit its kind."""

    def __init__(self, path: str, value: object, text: str) -> None:
        super().__init__(f"{path} is {short(value)}; it must be {text}")
        self.path = path
        self.value = value
        self.text = text


class _Fitting:
    """A converter of fields' values to the kinds of their annotations.

    Args:
        file: values are plain JSON from this file; None: they are declared.
    """

    def __init__(self, file: str | None = None) -> None:
        self.file = file

    def fit(self, kind: Any, value: Any, path: str) -> Any:
        """Return ``value``, the field ``path``, as a ``kind``.

        Raises:
            _Unfit: it does not fit; the error's ``path`` may be a part of the field.
        """
        value = value if kind is Any else _plain(value)
        if not self._form(kind, value)[0]:
            raise _Unfit(path, value, self.describe(kind) + _hint(kind, value))
        kind, checks = _parts(kind)
        text = ", ".join(check.text for check in checks)
        try:
            found = self._inside(kind, _converted(value, checks), path)
        except _Unfit as error:
            if text and error.path == path:
                error = _Unfit(path, value, text)
            raise error from None
        if not all(check.holds(found) for check in checks):
            raise _Unfit(path, value, text + _hint(kind, value))
        if kind in (int, float):
            whole = isinstance(found, int)
            if not whole and not math.isfinite(found):
                raise _Unfit(path, found, text or _FINITE)
            largest, limit = (LARGEST, "2^63") if whole else (LARGEST_FLOAT, "3.4e38")
            if abs(found) >= largest:
                raise _Unfit(path, found, f"below {limit}" if found > 0 else f"above -{limit}")
        return found

    def describe(self, kind: Any) -> str:
        """Return a description of valid values: "a whole number, at least 1, or None"."""
        words = self._form(kind, None)[1]
        choices = all(get_origin(k) is Literal or k is NoneType for k in options_of(kind))
        if len(words) > 1 and choices:
            return f"one of {', '.join(words)}"
        if len(words) == 1:
            return words[0]
        comma = "," if any("," in word for word in words) else ""
        return f"{', '.join(words[:-1])}{comma} or {words[-1]}"

    def _form(self, kind: Any, value: Any) -> tuple[bool, list[str]]:
        """Return whether a value is of a kind, without a check of its range and entries.

        With it come descriptions of such values: several where any of them will do.
        """
        recorded = isinstance(value, str) and RECORDED in get_args(kind)
        kind, checks = _parts(kind)
        fits = True
        try:
            value = _converted(value, checks)
        except Exception:  # any, as what is converted may be an object of the user
            fits = False
        is_kind, words = self._bare_form(kind, value)
        if checks:
            noun = {int: ["a whole number"], float: ["a number"]}.get(kind, [])
            words = [", ".join([*noun, *(check.text for check in checks)])]
        return (":" in value if recorded else fits and is_kind), words

    def _bare_form(self, kind: Any, value: Any) -> tuple[bool, list[str]]:
        """Return the same of a kind without checks."""
        origin, inner = get_origin(kind), get_args(kind)
        declared = self.file is None
        if origin in (Union, UnionType):
            forms = [self._form(option, value) for option in inner]
            return any(fits for fits, _ in forms), [w for _, words in forms for w in words]
        if kind in (None, NoneType):
            return value is None, ["None"]
        if kind is float:
            return type(value) in (int, float), [_FINITE]
        if kind is int:
            return type(value) is int, ["a whole number"]
        if kind is bool:
            return type(value) is bool, ["True", "False"] if declared else ["true", "false"]
        if kind is str:
            return isinstance(value, str), ["a text"]
        if origin is Literal:
            several = any(" " in str(word) for word in inner)  # words in one of them
            fits = any(isinstance(value, type(word)) and value == word for word in inner)
            return fits, [repr(word) if several else str(word) for word in inner]
        if kind is Callable or origin is Callable:
            return callable(value), ["a function"]
        if kind in (list, tuple) or origin in (list, tuple, Sequence):
            if isinstance(value, list | tuple) or not inner:
                return isinstance(value, list | tuple), ["a list"]
            if origin is tuple and Ellipsis not in inner:
                return False, [f"a list of {len(inner)}"]
            each = "" if inner[0] is Any else f", each entry {self.describe(inner[0])}"
            return False, [f"a list{each}"]
        named = isinstance(value, Mapping) and all(isinstance(k, str) for k in value)
        if kind is dict or origin in (dict, Mapping) or (not declared and _is_record(kind)):
            return named, ["a dict with texts as keys" if declared else "an object, in braces"]
        if not declared and kind is not Any:
            raise TypeError(f"no schema: {kind!r}")
        name = getattr(kind, "__name__", str(kind))
        words = [f"{name}()" if is_dataclass(kind) else f"an instance of {name}"]
        if kind is Any or not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
            return True, words
        return isinstance(value, kind) or (named and hasattr(kind, "_from_dict")), words

    def _inside(self, kind: Any, value: Any, path: str) -> Any:
        """Return a value of the right kind with its entries and fields fitted."""
        origin = get_origin(kind)
        inner = get_args(kind)
        if origin in (Union, UnionType):
            if value is None and NoneType in inner:
                return None
            option = next(k for k in inner if self._form(k, value)[0])
            try:
                return self.fit(option, value, path)
            except _Unfit as error:
                if error.path == path and NoneType in inner:
                    error = _Unfit(path, value, f"{error.text}, or None")
                raise error from None
        if isinstance(value, str) and len(value) > LONGEST_TEXT:
            raise _Unfit(path, value, f"a text of at most {LONGEST_TEXT} characters")
        if origin in (list, tuple, Sequence) and inner:
            return self._sequence(origin, inner, value, path)
        if origin in (dict, Mapping) and inner:
            return {
                self.fit(inner[0], k, f"{path}: a name"): self.fit(
                    inner[1], v, f"{path}[{short(k)}]"
                )
                for k, v in value.items()
            }
        if isinstance(value, Mapping) and _is_record(kind):
            return self._record(kind, value, path)
        return value

    def _sequence(self, origin: Any, inner: tuple[Any, ...], value: Any, path: str) -> Any:
        """Return a list or tuple whose entries fit the kinds of its annotation."""
        kinds: Sequence[Any] = inner
        if origin is not tuple or Ellipsis in inner:
            kinds = [inner[0]] * len(value)
        elif len(value) != len(inner):
            raise _Unfit(path, value, f"a list of {len(inner)}")
        made = type(value) if origin is Sequence else origin
        found = [
            self.fit(k, x, f"{path}[{i}]")
            for i, (k, x) in enumerate(zip(kinds, value, strict=True))
        ]
        same = type(value) is made and all(a is b for a, b in zip(found, value, strict=True))
        return value if same else made(found)

    def _record(self, kind: Any, given: Mapping[str, Any], path: str) -> Any:
        """Return the settings or the TypedDict that a dict names; of a file, each field fitted.

        Raises:
            DeclarationError: a name does not exist, or a value is wrong.
            RunError: so is a field of a file, or missing, or the fields do not fit each other.
        """
        values = dict(given)
        file = self.file
        if file is not None:
            self._fit_fields(kind, values, file, path)
        if is_typeddict(kind):
            return values
        try:
            return kind(**values)
        except SkillweaveError as error:
            if file is None:
                raise DeclarationError(f"{path}: {error}") from error
            raise RunError(f"{_at(file, path)}: {error}" if file else str(error)) from error

    def _fit_fields(self, kind: Any, values: dict[str, Any], file: str, path: str) -> None:
        """Fit the fields of a file's record in place; errors as of ``_record``."""
        hints = annotations_of(kind)
        needed = {name for name, hint in hints.items() if get_origin(hint) is not NotRequired}
        if is_dataclass(kind):
            own = saved_fields(kind)
            needed = {f.name for f in own if f.default is f.default_factory is MISSING}
            if unknown := sorted(values.keys() - {f.name for f in own}):
                raise RunError(
                    f"{_at(file, path)} has no field {', '.join(u[:60] for u in unknown[:3])}: "
                    "made by a newer version?"
                )
        for name, hint in hints.items():
            if name in values:
                inner = get_args(hint)[0] if get_origin(hint) is NotRequired else hint
                values[name] = self.fit(inner, values[name], f"{path}.{name}" if path else name)
            elif name in needed:
                what = f"{path} has no field {name!r}" if path else f"no field {name!r}"
                raise RunError(f"{file} is damaged: {what}" if file else what)


def _at(file: str, path: str) -> str:
    return ": ".join(part for part in (file, path) if part)


def _parts(kind: Any) -> tuple[Any, tuple[Check, ...]]:
    """Return a kind without its checks, and these."""
    if get_origin(kind) is not Annotated:
        return kind, ()
    inner, *notes = get_args(kind)
    return inner, tuple(note for note in notes if isinstance(note, Check))


def _converted(value: Any, checks: tuple[Check, ...]) -> Any:
    for check in checks:
        value = check.convert(value)
    return value


def _plain(value: Any) -> Any:
    """Return NumPy's numbers and texts as Python's, where Python has them."""
    found = value.item() if isinstance(value, np.generic) else value
    return value if isinstance(found, np.generic) else found


def _is_record(kind: Any) -> bool:
    return is_dataclass(kind) or is_typeddict(kind)


def _hint(kind: Any, value: Any) -> str:
    """Return advice where a class, or a dict, was given in place of settings."""
    kinds: tuple[Any, ...] = tuple(k for k in options_of(kind) if is_dataclass(k))
    if isinstance(value, type) and issubclass(value, kinds):
        return f" (write {value.__name__}(), not {value.__name__})"
    if isinstance(value, Mapping) and value and len(kinds) == 1:
        group = kinds[0].__name__
        known = [f.name for f in fields(kinds[0])]
        for name in value:
            if name not in known:
                return f" ({group} has no setting {name!r}{suggest(name, known)})"
        given = ", ".join(f"{k}={short(v, 40)}" for k, v in value.items())
        return f" (write {group}({given}))"
    return ""


def options_of(kind: Any) -> list[Any]:
    """Return the kinds of a union, also of one in it, without their checks."""
    kind, _ = _parts(kind)
    if get_origin(kind) not in (Union, UnionType):
        return [kind]
    return [option for inner in get_args(kind) for option in options_of(inner)]


# Writing


def flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Return settings of a dataclass by name, those in a group by dotted names.

    Args:
        settings: a dataclass.
        prefix: the start of all names.
    """
    values: dict[str, Any] = {}
    for name in (f.name for f in fields(settings)):
        value = getattr(settings, name)
        group = flat(value, f"{prefix}{name}.") if is_dataclass(value) else {prefix + name: value}
        values |= group
    return values


def to_json(value: Any, where: str, advice: str) -> Any:
    """Convert settings to plain JSON: NumPy's numbers to Python's, tuples to lists.

    A dataclass becomes a dict of its fields.

    Args:
        value: the settings.
        where: their name in messages, to which places are added: ``kwargs['sizes'][0]``.
        advice: the end of messages, what to do.

    Raises:
        DeclarationError: a value is in them that writing and reading would change.
    """
    value = _plain(value)
    if isinstance(value, str):
        return str(value)  # a function of the user is recorded by its name
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    if is_dataclass(value):
        return {
            f.name: to_json(getattr(value, f.name), f"{where}.{f.name}", advice)
            for f in fields(value)
        }
    if isinstance(value, list | tuple):
        return [to_json(x, f"{where}[{i}]", advice) for i, x in enumerate(value)]
    if isinstance(value, Mapping) and all(isinstance(k, str) for k in value):
        return {k: to_json(x, f"{where}[{k!r}]", advice) for k, x in value.items()}
    keys = " with keys that are no text" if isinstance(value, Mapping) else ""
    raise DeclarationError(
        f"{where} is {short(value)}{keys}, but a run records only finite numbers, texts, and lists "
        f"and dicts of them; {advice}"
    )


UNSAVED = {"saved": False}
"""The metadata of a field that files do not hold."""


def saved_fields(kind: Any) -> list[Field[Any]]:
    """Return the fields of a dataclass that files hold."""
    return [f for f in fields(kind) if f.metadata.get("saved", True)]


def as_json(value: Any) -> Any:
    """Return a record of a file as plain JSON, without fields that are None or empty by default."""
    if is_dataclass(value):
        return {
            f.name: as_json(content)
            for f in saved_fields(value)
            if (content := getattr(value, f.name)) not in (None, [], (), {})
            or f.default is f.default_factory is MISSING
        }
    if isinstance(value, Mapping):
        return {k: as_json(x) for k, x in value.items()}
    return [as_json(x) for x in value] if isinstance(value, list | tuple) else value


# Settings


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def settings(kind: C) -> C:
    """Make a class a frozen dataclass that checks every field when an object is made.

    Names are checked as by ``checked_names``. NumPy's numbers become Python's, and a field that
    holds other settings also takes a dict of them. The fields of subclasses are checked, too.
    Conditions on several fields belong into ``__post_init__``, which finds every field checked.

    Raises:
        DeclarationError: when an object is made: ``PPO.gamma is 1.5; it must be between 0 and 1``.
    """
    cls: Any = kind
    own = getattr(cls, "__post_init__", None)

    def checked(self: Any) -> None:
        """Check all fields by their annotations, then run the class's own checks."""
        first = next(k for k in type(self).__mro__ if "_checks_fields" in vars(k))
        if first is kind:  # else the subclass that called this has checked already
            check_fields(self)
        if own is not None:
            own(self)

    cls._checks_fields = True
    cls.__post_init__ = checked
    checked_names(dataclass(frozen=True)(cls))
    return kind


def check_fields(settings: Any) -> None:
    """Check every field of a dataclass by its annotation, and convert it to its plainest form.

    Raises:
        DeclarationError: a field does not fit; the message names its class and the field.
    """
    kind = type(settings)
    hints = annotations_of(kind)
    for name in (f.name for f in fields(settings) if f.name in hints):
        value = getattr(settings, name)
        found = fitted(hints[name], value, f"{kind.__name__}.{name}")
        if found is not value:
            object.__setattr__(settings, name, found)


def check(settings: object, name: str, ok: bool, text: str) -> None:
    """Raise a DeclarationError that names a field and its valid values, if not ``ok``."""
    if not ok:
        where = f"{type(settings).__name__}.{name}"
        raise DeclarationError(str(_Unfit(where, getattr(settings, name), text)))


def annotations_of(kind: Any) -> dict[str, Any]:
    """Return the annotations of a class's fields, with their checks.

    A user's subclass of settings cannot loosen the checks of the fields that it inherits. Where it
    names a type that only type checkers import, its own fields are not checked.
    """
    return _annotations_of(kind)


@cache
def _annotations_of(kind: Any) -> dict[str, Any]:
    """Return the annotations of a settings class's fields, those of its bases included."""
    base = next((k for k in kind.__mro__ if "_checks_fields" in vars(k)), None)
    if base is None or base is kind:
        return get_type_hints(kind, include_extras=True)
    try:
        own = get_type_hints(kind, include_extras=True)
    except Exception:  # any, as annotations are code of the user
        own = {}
    return own | annotations_of(base)
