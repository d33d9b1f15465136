"""Every public name says what it is, what it takes, of which shape, what it returns and raises."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

import pytest

import skillweave as sw

ALIASES = {"Array": "a name for NumPy's ndarray, explained in the reference"}
ARRAY = re.compile(r"\b(Array|Tensor|Views|Float|Int|Bool)\b")


def public_functions(name: str) -> Iterator[tuple[str, Any]]:
    """The function of this name; or the constructor and public methods of the class."""
    thing = getattr(sw, name)
    if inspect.ismodule(thing):
        for part in vars(thing).values():
            if inspect.isclass(part) and part.__module__ == thing.__name__:
                yield f"{name}.{part.__name__}", part
    elif inspect.isclass(thing):
        yield name, thing
        for key, value in inspect.getmembers_static(thing):
            ours = any(key in vars(c) and c.__module__.startswith("skillweave") for c in thing.__mro__)
            plain = value.__func__ if isinstance(value, classmethod | staticmethod) else value
            if not key.startswith("_") and ours and inspect.isfunction(plain):
                yield f"{name}.{key}", plain
    else:
        yield name, thing


def arguments_of(thing: Any) -> dict[str, str]:
    """Its arguments with their annotations."""
    if inspect.isclass(thing) and (dataclasses.is_dataclass(thing) or issubclass(thing, Exception)):
        return {}
    if getattr(thing, "_is_protocol", False):
        return {}
    function = thing.__init__ if inspect.isclass(thing) else thing
    if function is object.__init__:
        return {}
    found = list(inspect.signature(function).parameters.values())
    return {p.name: str(p.annotation) for p in found if p.name not in ("self", "cls")}


def text_of(thing: Any) -> str:
    """Its docstring; of an override the one that it inherits."""
    return inspect.getdoc(thing) or ""


def section(text: str, title: str) -> str:
    """The indented lines under ``Args:``, ``Returns:`` or ``Raises:``."""
    found = re.search(rf"^{title}:\n((?:    .*\n?|\n)+)", text, flags=re.M)
    return found[1] if found else ""


def raises(thing: Any) -> bool:
    """Whether it raises an error for people itself."""
    function = thing
    if inspect.isclass(thing):  # a dataclass checks itself in __post_init__
        kind = "__post_init__" if dataclasses.is_dataclass(thing) else "__init__"
        function = vars(thing).get(kind)
    if function is None:
        return False
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    return any(
        isinstance(n, ast.Raise) and "SkillweaveError" in ast.dump(n) for n in ast.walk(tree)
    )


def missing(thing: Any) -> list[str]:
    """What a docstring does not say."""
    text = text_of(thing)
    lacks: list[str] = []
    first = text.split("\n\n")[0].strip()
    if not first.endswith((".", ":")) or len(first.split()) < 3:
        lacks.append("a sentence")
    listed = section(text, "Args") + section(text, "Attributes")
    for name, kind in arguments_of(thing).items():
        entry = re.search(rf"^    \*{{0,2}}{name}: ((?:.|\n(?!    \S))+)", listed, flags=re.M)
        said = entry[1] if entry else ""
        if not said and f"``{name}``" not in text:
            lacks.append(f"argument {name}")
    if not inspect.isclass(thing):
        kind = str(inspect.signature(thing).return_annotation)
        if ARRAY.search(kind) and not re.search(r"\([^)]*[A-Zn]\b[^)]*\)|\(…\)|\(\.\.\.", text):
            lacks.append(f"the shape of {kind}")
    if raises(thing) and "Raises:" not in text and "Raise a SkillweaveError" not in text:
        lacks.append("its errors")
    return lacks


if __name__ == "__main__":
    total=0
    for n in sw.__all__:
        if n in ALIASES: continue
        for where, thing in public_functions(n):
            if m := missing(thing):
                print(where, inspect.getsourcefile(thing).split("skillweave/",1)[1], m); total+=len(m)
    print(total)
