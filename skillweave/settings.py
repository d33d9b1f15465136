"""Settings whose annotations are their checks.

``gamma: Fraction = 0.99`` says that γ lies between 0 and 1. ``@checked_settings`` above a dataclass
checks every field by its annotation when an object is made, and ``reading.fit`` compares files with
the same annotations. This module does not import torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, wraps
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from skillweave.arguments import checked_names, meant
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.messages import short

C = TypeVar("C", bound=type[Any])

LARGEST = 2**63
"""The limit of whole numbers."""
LARGEST_FLOAT = 3.4e38
"""The limit of other numbers, which tensors of float32 must represent."""
LONGEST_TEXT = 4096
"""The most characters of a text: the longest path that a system accepts."""


# Kinds of values


class Check(NamedTuple):
    """A condition on a field: ``Annotated[int, Check("at least 1", lambda x: x >= 1)]``.

    Beside numbers the text continues "a whole number". Beside any other type it replaces the
    description of the type.
    """

    text: str
    holds: Callable[[Any], bool] = lambda _: True


AtLeastOne = Annotated[int, Check("at least 1", lambda x: x >= 1)]
"""A whole number of at least 1."""
Count = Annotated[int, Check("at least 0", lambda x: x >= 0)]
"""A whole number of at least 0."""
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


# Fitting a value to a kind


class Unfit(Exception):
    """A value does not fit its kind."""

    def __init__(self, path: str, value: object, text: str) -> None:
        super().__init__(f"{path} is {short(value)}; it must be {text}")
        self.path = path
        self.value = value
        self.text = text


class Fitting:
    """A converter of values to kinds: types, or any annotation of a field.

    Settings use this class, files a subclass in ``reading``.
    """

    yes_and_no: tuple[str, str] = "True", "False"
    mapping: str = "a dict with texts as keys"

    def fit(self, kind: Any, value: Any, path: str) -> Any:
        """Convert ``value`` to a ``kind``.

        Lists become tuples and dicts become settings where the kind needs them; NumPy's numbers
        become Python's.

        Args:
            path: the field, for messages: ``PPO.gamma``.

        Raises:
            Unfit: it does not fit; the error's ``path`` may be a part of the field.
        """
        value = value if kind is Any else _plain(value)
        if not self.accepts(kind, value):
            raise Unfit(path, value, self.describe(kind) + _hint(kind, value))
        kind, checks = _parts(kind)
        text = ", ".join(check.text for check in checks)
        try:
            found = self._inside(kind, value, path)
        except Unfit as error:
            if text and error.path == path:
                error = Unfit(path, value, text)
            raise error from None
        if not all(check.holds(found) for check in checks):
            raise Unfit(path, value, text + _hint(kind, value))
        if kind in (int, float):
            _check_size(found, path, checks)
        return found

    def accepts(self, kind: Any, value: Any) -> bool:
        """Return whether a value is of a kind, without a check of its range and entries."""
        if isinstance(value, str) and get_origin(kind) is Annotated and RECORDED in get_args(kind):
            return ":" in value
        kind, _ = _parts(kind)
        origin = get_origin(kind)
        inner = get_args(kind)
        if origin in (Union, UnionType):
            return any(self.accepts(option, value) for option in inner)
        if kind in (None, NoneType):
            return value is None
        if kind is float:
            return type(value) in (int, float)
        if kind in (int, bool):
            return type(value) is kind
        if kind is str:
            return isinstance(value, str)
        if origin is Literal:
            return any(isinstance(value, type(word)) and value == word for word in inner)
        if _callable(kind):
            return callable(value)
        if kind in (list, tuple) or origin in (list, tuple, Sequence):
            return isinstance(value, list | tuple)
        if kind is dict or origin in (dict, Mapping):
            return _has_names(value)
        return self.accepts_other(kind, value)

    def accepts_other(self, kind: Any, value: Any) -> bool:
        """Return whether a value is of a kind that is a class; other kinds are not checked."""
        if kind is Any or not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
            return True
        if getattr(kind, "_from_dict", False) and _has_names(value):
            return True
        return isinstance(value, kind)

    def record(self, kind: Any, value: Any, path: str) -> Any:
        """Return the settings that a dict names.

        Raises:
            DeclarationError: a name does not exist, or a value is wrong.
        """
        try:
            return kind(**value)
        except SkillweaveError as error:
            raise DeclarationError(f"{path}: {error}") from error

    def describe(self, kind: Any) -> str:
        """Return a description of valid values: "a whole number, at least 1, or None"."""
        words = self._words(kind)
        options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
        if len(words) > 1 and all(get_origin(k) is Literal or k is NoneType for k in options):
            return f"one of {', '.join(words)}"
        if len(words) == 1:
            return words[0]
        comma = "," if any("," in word for word in words) else ""
        return f"{', '.join(words[:-1])}{comma} or {words[-1]}"

    def _words(self, kind: Any) -> list[str]:
        """Return descriptions of the values of a kind: several where any of them will do."""
        kind, checks = _parts(kind)
        texts = [check.text for check in checks]
        if kind in (int, float):
            noun = "a whole number" if kind is int else "a number" if texts else _FINITE
            return [", ".join([noun, *texts])]
        if texts:
            return [", ".join(texts)]
        origin = get_origin(kind)
        inner = get_args(kind)
        if origin in (Union, UnionType):
            return [word for option in inner for word in self._words(option)]
        if kind is str:
            return ["a text"]
        if kind is bool:
            return list(self.yes_and_no)
        if origin is Literal:
            several = any(" " in str(word) for word in inner)  # words in one of them
            return [repr(word) if several else str(word) for word in inner]
        if kind in (None, NoneType):
            return ["None"]
        if _callable(kind):
            return ["a function"]
        if kind in (list, tuple) or (origin in (list, tuple, Sequence) and not inner):
            return ["a list"]
        if origin in (list, tuple, Sequence):
            each = [k for k in inner if k is not Ellipsis]
            if origin is tuple and Ellipsis not in inner:
                return [f"a list of {len(each)}"]
            return ["a list" if each[0] is Any else f"a list, each entry {self.describe(each[0])}"]
        if kind is dict or origin in (dict, Mapping):
            return [self.mapping]
        return [self.describe_other(kind)]

    def describe_other(self, kind: Any) -> str:
        """Return the name of an instance of a class."""
        name = getattr(kind, "__name__", str(kind))
        return f"{name}()" if is_dataclass(kind) else f"an instance of {name}"

    def _inside(self, kind: Any, value: Any, path: str) -> Any:
        """Return a value of the right kind with its entries and fields fitted."""
        origin = get_origin(kind)
        inner = get_args(kind)
        if origin in (Union, UnionType):
            if value is None and NoneType in inner:
                return None
            option = next(k for k in inner if self.accepts(k, value))
            try:
                return self.fit(option, value, path)
            except Unfit as error:
                if error.path == path and NoneType in inner:
                    error = Unfit(path, value, f"{error.text}, or None")
                raise error from None
        if isinstance(value, str) and len(value) > LONGEST_TEXT:
            raise Unfit(path, value, f"a text of at most {LONGEST_TEXT} characters")
        if origin in (list, tuple, Sequence) and inner:
            return self._sequence(origin, inner, value, path)
        if origin in (dict, Mapping) and inner:
            return {k: self.fit(inner[1], v, f"{path}[{short(k)}]") for k, v in value.items()}
        if isinstance(value, Mapping) and _is_record(kind):
            return self.record(kind, value, path)
        return value

    def _sequence(self, origin: Any, inner: tuple[Any, ...], value: Any, path: str) -> Any:
        if origin is tuple and Ellipsis not in inner:
            kinds = list(inner)
            if len(value) != len(kinds):
                raise Unfit(path, value, f"a list of {len(kinds)}")
        else:
            kinds = [inner[0]] * len(value)
        made = type(value) if origin is Sequence else origin
        found = [
            self.fit(k, x, f"{path}[{i}]")
            for i, (k, x) in enumerate(zip(kinds, value, strict=True))
        ]
        same = type(value) is made and all(a is b for a, b in zip(found, value, strict=True))
        return value if same else made(found)


_FINITE = "a finite number"
_SETTINGS = Fitting()


def _parts(kind: Any) -> tuple[Any, tuple[Check, ...]]:
    """Return a kind without its checks, and these."""
    if get_origin(kind) is not Annotated:
        return kind, ()
    inner, *notes = get_args(kind)
    return inner, tuple(note for note in notes if isinstance(note, Check))


def _plain(value: Any) -> Any:
    """Return NumPy's numbers and texts as Python's, where Python has them."""
    found = value.item() if isinstance(value, np.generic) else value
    return value if isinstance(found, np.generic) else found


def _callable(kind: Any) -> bool:
    return kind is Callable or get_origin(kind) is Callable


def _is_record(kind: Any) -> bool:
    return is_dataclass(kind) or (isinstance(kind, type) and issubclass(kind, dict))


def _has_names(value: Any) -> bool:
    return isinstance(value, Mapping) and all(isinstance(k, str) for k in value)


def _hint(kind: Any, value: Any) -> str:
    """Return advice where a class, or a dict, was given in place of settings."""
    kinds: tuple[Any, ...] = tuple(k for k in options_of(kind) if is_dataclass(k))
    if isinstance(value, type) and issubclass(value, kinds):
        return f" (write {value.__name__}(), not {value.__name__})"
    if _has_names(value) and value and len(kinds) == 1:
        group = kinds[0].__name__
        known = [f.name for f in fields(kinds[0])]
        for name in value:
            if name not in known:
                return f" ({group} has no setting {name!r}{meant(name, known, 'they are')})"
        settings = ", ".join(f"{k}={short(v, 40)}" for k, v in value.items())
        return f" (write {group}({settings}))"
    return ""


def options_of(kind: Any) -> list[Any]:
    """Return the kinds of a union, also of one in it, without their checks."""
    kind, _ = _parts(kind)
    if get_origin(kind) not in (Union, UnionType):
        return [kind]
    return [option for inner in get_args(kind) for option in options_of(inner)]


def _check_size(value: int | float, path: str, checks: tuple[Check, ...]) -> None:
    """Raise Unfit where a number is not finite or too large to be computed with."""
    if not isinstance(value, int) and not math.isfinite(value):
        raise Unfit(path, value, ", ".join(c.text for c in checks) or _FINITE)
    largest, text = (LARGEST, "2^63") if isinstance(value, int) else (LARGEST_FLOAT, "3.4e38")
    if abs(value) >= largest:
        raise Unfit(path, value, f"below {text}" if value > 0 else f"above -{text}")


# Settings


def checked_settings(kind: C) -> C:
    """Let a dataclass of settings check every field by its annotation when an object is made.

    Names are checked as by ``checked_names``. NumPy's numbers become Python's, and a field that
    holds other settings also takes a dict of them. The fields of subclasses are checked, too.
    A method ``_convert`` may bring other forms of a field into that of its annotation first.
    Conditions on several fields belong into ``__post_init__``, which finds every field checked.

    Raises:
        DeclarationError: when an object is made: ``PPO.gamma is 1.5; it must be between 0 and 1``.
    """
    cls: Any = checked_names(kind)
    own = getattr(cls, "__post_init__", None)
    init = cls.__init__

    def checked(self: Any) -> None:
        first = next(k for k in type(self).__mro__ if "_checks_fields" in vars(k))
        if first is kind:  # else the subclass that called this has checked already
            if hasattr(self, "_convert"):
                self._convert()
            check_fields(self)
        if own is not None:
            own(self)

    cls._checks_fields = True
    cls.__post_init__ = checked
    if own is None:  # then what ``@dataclass`` has made calls none

        @wraps(init)
        def made(self: Any, *args: Any, **named: Any) -> None:
            init(self, *args, **named)
            checked(self)

        cls.__init__ = made
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


def fitted(kind: Any, value: Any, where: str) -> Any:
    """Return a setting in its plainest form; see ``Fitting.fit``.

    Args:
        kind: its annotation.
        where: the setting, for messages.

    Raises:
        DeclarationError: it does not fit.
    """
    try:
        return _SETTINGS.fit(kind, value, where)
    except Unfit as error:
        raise DeclarationError(str(error)) from None


def described(kind: Any) -> str:
    """Return a description of valid settings: "a whole number, at least 1, or None"."""
    return _SETTINGS.describe(kind)


def check(settings: object, name: str, ok: bool, text: str) -> None:
    """Raise a DeclarationError that names a field and its valid values, if not ``ok``."""
    if not ok:
        where = f"{type(settings).__name__}.{name}"
        raise DeclarationError(str(Unfit(where, getattr(settings, name), text)))


def annotations_of(kind: Any) -> dict[str, Any]:
    """Return the annotations of a class's fields, with their checks.

    A user's subclass of settings cannot loosen the checks of the fields that it inherits. Where it
    names a type that only type checkers import, its own fields are not checked.
    """
    return _annotations_of(kind)


@cache
def _annotations_of(kind: Any) -> dict[str, Any]:
    base = next((k for k in kind.__mro__ if "_checks_fields" in vars(k)), None)
    if base is None or base is kind:
        return get_type_hints(kind, include_extras=True)
    try:
        own = get_type_hints(kind, include_extras=True)
    except Exception:  # any, as annotations are code of the user
        own = {}
    return own | annotations_of(base)
