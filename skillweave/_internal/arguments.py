"""Errors for wrong arguments and attributes: they name the one that was probably meant.

``@checked_names`` decorates public functions and classes. Where an argument is misspelt, missing
or one too many, it raises a ``DeclarationError`` with the right spelling, in place of Python's
TypeError; and it refuses to set an attribute that does not exist.
"""

from __future__ import annotations

import functools
import inspect
import types
import typing
from collections.abc import Callable
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, TypeVar

from skillweave._internal.messages import ELSEWHERE, RECORDINGS, STARTS, short, suggest
from skillweave.errors import DeclarationError
from skillweave.policies.floats import usual_floats

T = TypeVar("T", bound=Callable[..., Any])


def checked_names(target: T) -> T:
    """Let a function, or a class, raise a DeclarationError where its arguments are wrong.

    Of a dataclass, attributes are checked as well: a frozen one's cannot be set, those of
    another only if they exist.

    Args:
        target: a function, a method, or a class (above ``@dataclass``, if it is one).

    Returns:
        The function with its signature; the same class.
    """
    if not isinstance(target, type):
        return typing.cast(T, _checked(target))
    kind: Any = target
    kind.__init__ = _checked(kind.__init__)
    if "__dataclass_params__" in vars(kind):
        kind.__setattr__ = _set
    return target


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose wrong arguments raise a DeclarationError with a hint."""

    @functools.wraps(function)
    def checked(*args: Any, **named: Any) -> Any:
        """Call the function; explain a TypeError where its arguments do not fit."""
        try:
            with usual_floats():
                return function(*args, **named)
        except TypeError:
            # The function's body may have raised it: then the arguments fit.
            if (wrong := _wrong_arguments(function, args, named)) is None:
                raise
        raise DeclarationError(wrong)

    return checked


def _wrong_arguments(
    function: Callable[..., Any], args: tuple[Any, ...], named: dict[str, Any]
) -> str | None:
    """Return a sentence about arguments that do not fit a function; None: they fit."""
    signature = inspect.signature(function)
    with suppress(TypeError):
        signature.bind(*args, **named)
        return None
    parameters = list(signature.parameters.values())
    owner: Any = None
    if parameters and parameters[0].name in ("self", "cls") and args:
        owner = args[0] if isinstance(args[0], type) else type(args[0])
        parameters = parameters[1:]
        args = args[1:]
    makes = function.__name__ == "__init__" and owner is not None
    name = owner.__name__ if makes else function.__name__
    who, what = (name, "setting") if makes and is_dataclass(owner) else (f"{name}()", "argument")
    if makes and not parameters:
        example = next((f"{k} = {short(v, 40)}" for k, v in named.items()), "")
        advice = f"write {example} in the body of the class, or give" if example else "give"
        return f"{who} takes no arguments: {advice} it an __init__ of its own"
    takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters)
    parameters = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    by_name = [p.name for p in parameters if p.kind is not p.POSITIONAL_ONLY]
    if not takes_all and (unknown := [k for k in named if k not in by_name]):
        first = unknown[0]
        end = suggest(first, by_name, {} if owner is None else _other_places(owner, makes))
        if (way := ELSEWHERE.get(first)) in (STARTS, RECORDINGS):
            end = f": {way}"
        return f"{who} has no {what} {first!r}{end}"
    ordered = [p for p in parameters if p.kind is not p.KEYWORD_ONLY]
    if len(args) > len(ordered):
        most = f"at most {len(ordered)}" if ordered else "none"
        rest = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in named]
        hint = f": name the others, {rest[0]}=... for example" if rest else ""
        return f"{who} takes {most} of its arguments by position, but {len(args)} were given{hint}"
    if twice := [p.name for p in ordered[: len(args)] if p.name in named]:
        return f"{who} was given {twice[0]} twice, by position and by name: leave one of them out"
    given = {p.name for p in ordered[: len(args)]} | named.keys()
    needed = [p for p in parameters if p.default is p.empty]
    lacking = " and ".join(p.name for p in needed if p.name not in given)
    example = ", ".join(f"{p.name}=..." if p.kind is p.KEYWORD_ONLY else p.name for p in needed)
    return f"{who} needs {lacking}: write {name}({example})"


def _other_places(owner: type, makes: bool) -> dict[str, str]:
    """Return the other places of a class's arguments by name: its settings, ``train``."""
    if not makes:
        return _settings(owner, owner.__name__, f"{owner.__name__}({{}})")
    train: Any = getattr(owner, "train", None)
    names = inspect.signature(train).parameters if callable(train) else {}
    places = {k: f"an argument of train(): write train({k}=...)" for k in names if k != "self"}
    return places | _settings(owner, "", "{}")


def _settings(kind: Any, group: str, example: str) -> dict[str, str]:
    """Return by name where settings of a dataclass are given, to hint at the meant one."""
    inside: dict[str, str] = {}
    own = fields(kind) if is_dataclass(kind) else ()
    for field in reversed(own):
        if (below := _group(kind, field)) is not None:
            call = example.format(f"{field.name}={below.__name__}({{}})")
            inside |= _settings(below, field.name, call)
    texts = {f.name: example.format(f"{f.name}=...") for f in own}
    return inside | {k: f"a setting of {group}: write {text}" for k, text in texts.items()}


def _group(owner: Any, field: Any) -> Any:
    """Return the dataclass of a field's settings, to hint at the names in it; None: others."""
    made = field.default if field.default_factory is MISSING else field.default_factory()
    if is_dataclass(made) and not isinstance(made, type):
        return type(made)
    try:
        hint = typing.get_type_hints(owner)[field.name]
    except Exception:  # a name that only type checkers import
        return None
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    options = [t for t in typing.get_args(hint) if t is not type(None)] if union else [hint]
    one = options[0] if len(options) == 1 else None
    return one if isinstance(one, type) and is_dataclass(one) else None


def _set(self: Any, name: str, value: Any) -> None:
    """Set an attribute that exists, or a private one, unless frozen; else hint at the meant one."""
    kind = type(self)
    own = [f.name for f in fields(self)]
    frozen = kind.__dataclass_params__.frozen
    if name not in own and (frozen or not (name.startswith("_") or hasattr(kind, name))):
        # A user's subclass may have attributes of its own, but none that looks like a misspelt one.
        free = not frozen and kind.__module__.split(".")[0] != __name__.split(".")[0]
        places = {} if free else _settings(kind, "", "{}")
        end = suggest(name, own, places, least=0.85 if free else 0.6, listed=not free)
        if end or not free:
            raise DeclarationError(f"{kind.__name__} has no setting {name!r}{end}")
    if frozen:
        raise DeclarationError(
            f"{kind.__name__} cannot be changed: make another one, with "
            f"dataclasses.replace(..., {name}={short(value)})"
        )
    if isinstance(computed := getattr(kind, name, None), property) and computed.fset is None:
        raise DeclarationError(f"{kind.__name__}.{name} is computed; it cannot be set")
    object.__setattr__(self, name, value)


__all__ = ["checked_names"]
