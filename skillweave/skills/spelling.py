"""Attributes of a user's skill that look misspelt, for the warnings of its declaration."""

from __future__ import annotations

import difflib
import types
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from skillweave._internal.messages import ELSEWHERE

SIMILAR = 0.9
"""The least similarity of a name to the attribute that it resembles, as ``difflib``'s ratio."""


def misspelt(skill: Any, base: type, known: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield names in a skill that are probably misspelt attributes, with these attributes.

    Names that the skill's methods use are no mistake, and neither are names that begin with "_".

    Args:
        skill: an instance of a subclass of ``base``.
        base: the class ``Skill``.
        known: the attributes that a skill may define, and what is meant instead.
    """
    known = list(known)
    kinds = type(skill).__mro__[: type(skill).__mro__.index(base)]
    declared = {k: v for kind in reversed(kinds) for k, v in vars(kind).items()} | vars(skill)
    used = set().union(*(_used(v) for v in declared.values()))
    for name in declared:
        if name.startswith("_") or name in dir(base):
            continue
        near = difflib.get_close_matches(name, known, n=1, cutoff=SIMILAR)
        elsewhere = ELSEWHERE.get(name)
        if near:
            yield name, near[0]
        elif elsewhere in known and name not in used:
            yield name, elsewhere


def _used(value: Any) -> set[str]:
    """Return the names that a method of a user's skill reads, which are not misspelt."""
    function: Callable[..., Any] | None = getattr(value, "fget", None)
    function = function or getattr(value, "__func__", None) or value
    code = getattr(function, "__code__", None)
    return set() if code is None else _names(code)


def _names(code: types.CodeType) -> set[str]:
    inner = (_names(part) for part in code.co_consts if isinstance(part, types.CodeType))
    return set(code.co_names).union(*inner)
