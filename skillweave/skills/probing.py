"""Tests of each user's function at its first call.

A function that ignores the axis of the environments may return the right shape by chance:
``step.next_obs[0]`` has four numbers for four environments of CartPole. So the function is also
called with rows of its first call, repeated or cut to 3 and to more environments.

A function that keeps a state of its own answers otherwise after other calls. So it is called with
the same rows again, and with zeros and large numbers before and after them. Afterwards, the random
streams of Python, NumPy, torch and the function's objects are restored.
"""

from __future__ import annotations

import copy
import inspect
import itertools
import random
import sys
import types
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import numpy as np

from skillweave._internal.messages import error_text
from skillweave._internal.notices import notice
from skillweave._internal.tracebacks import is_own_code
from skillweave.errors import SkillError, SkillweaveError
from skillweave.policies.infos import with_missing
from skillweave.policies.spaces import Space, discrete
from skillweave.types import Array, Step, read_only

MOST = 256
"""The most environments at which a function is also called with more of them."""
AXIS = (
    "the first axis of every array is that of the environments: step.next_obs[:, 0], obs[:, 0], "
    "axis=1"
)
"""Advice in messages."""
OTHERS = ("torch", "gymnasium")
"""Packages whose objects may keep a state: modules and environments."""
GENERATORS = (random.Random, np.random.Generator, np.random.RandomState)
CHANGING = (dict, list, set, deque, np.ndarray, *GENERATORS)
"""Kinds of attributes that a function may change in place."""
DEPTH = 3
"""The most objects between a function and an attribute that it writes."""
REMEMBER = (
    "compute the answer from the argument alone, and let the environment, or a wrapper, put what "
    "must be remembered into the observation or info. A policy may have a state: "
    "sw.from_function(function, state=shape). Where a reward should change (a bonus for what was "
    "seldom seen), say so in its class: reward_changes = True"
)
"""Advice about functions that keep a state of their own."""


_notes: dict[int, tuple[weakref.ref[Any], dict[Any, Any]]] = {}


def _notes_of(owner: Any) -> dict[Any, Any] | None:
    """Return this process's notes about an object; None: it can have none.

    Under the name of a function stands what is wrong with it, until it is said.
    """
    key = id(owner)
    if key not in _notes:
        try:
            reference = weakref.ref(owner, lambda _: _notes.pop(key, None))
        except TypeError:  # of some objects written in C
            return None
        _notes[key] = reference, {}
    return _notes[key][1]


def first_time(owner: Any, *what: str) -> bool:
    """Return whether this is the first call with these arguments."""
    notes = _notes_of(owner)
    if notes is None or what in notes:
        return False
    notes[what] = True
    return True


def watch(
    function: Callable[..., Any], given: Any, more: tuple[Any, ...], who: str, judges: bool | None
) -> None:
    """Give a notice where a function of the user keeps a state of its own, at its second call.

    Before its first call, it is called with other arguments, too.

    Args:
        given: its argument; a dict: arguments by name.
        more: further arguments.
        who: its name in messages.
        judges: its answer to the same must never change; None: it may keep a state.

    Raises:
        SkillError: ``judges``, and the answer changes.
    """
    owner, name = _owner_and_name(function)
    if judges is None or str(getattr(function, "__module__", "")).startswith("skillweave."):
        return
    notes = _notes_of(owner)
    if notes is None:
        return
    fault, notes[name] = notes.get(name), ""
    if fault:
        notice(f"{who} {fault}")
    elif fault is None and (names := _written(function, given, more, who if judges else "")):
        notes[name] = (
            f"writes {', '.join(names[:4])}, and answers by it. It runs on from one episode into "
            f"the next, and all environments share it: {REMEMBER}"
        )


def _owner_and_name(function: Any) -> tuple[Any, str]:
    """Return what the notes about a function stand under."""
    while isinstance(function, partial):
        function = function.func
    return getattr(function, "__self__", function), getattr(function, "__name__", "")


@np.errstate(all="ignore")
def _written(
    function: Callable[..., Any], given: Any, more: tuple[Any, ...], who: str
) -> list[str]:
    """Return the names of what a function writes, if answers depend on the calls before.

    Args:
        who: its name in a SkillError, raised where it answers otherwise when it is called again;
            empty: this is no error.
    """
    n = _count(given)
    others = [_taken(given, np.arange(n), n, factor) for factor in (0, 100, -100)]
    with untouched(function) as spaces:
        order = (given, given, *others, given) if spaces else (given, given) if who else ()
        in_turn = [_answer(function, x, more, spaces) for x in order]
        names = [
            str(name)
            for space, values in spaces
            for name, value in space.items()
            if not isinstance(value, GENERATORS) and not _close(value, values.get(name))
        ]
    if who and not _close(*in_turn[:2]):
        with suppress(TypeError, ValueError):  # no numbers: this is said elsewhere
            before, after = np.array(in_turn[:2], float)
            row = np.abs(after - before).argmax()
            raise SkillError(
                f"{who} answers {before[row]:g}, and {after[row]:g} when it is asked about the "
                "same again, so it keeps a state of its own. Steps are judged in any order and "
                f"number, and later than they were made: {REMEMBER}"
            )
    alone = []
    for x in (given, given, given, *others) if names else ():
        with untouched(function) as spaces:
            alone.append(_answer(function, x, more, spaces))
    # First answers differ by random numbers of an unknown source alone.
    if not all(_close(first, in_turn[0]) for first in alone[:3]):
        return []
    return [] if all(map(_close, [*alone[1:], *alone[:1]], in_turn)) else names


Spaces = list[tuple[dict[str, Any], dict[str, Any]]]


def _answer(function: Callable[..., Any], given: Any, more: tuple[Any, ...], spaces: Spaces) -> Any:
    """Return the answer of a function with the random numbers of its first call."""
    for space, values in spaces:
        space.update({k: _copied(v) for k, v in values.items() if isinstance(v, GENERATORS)})
    more = tuple(map(_copied, more))
    with untouched(None), suppress(Exception, SystemExit):
        return function(**given) if isinstance(given, dict) else function(given, *more)
    return None


def _close(one: Any, other: Any) -> bool:
    """Return whether two answers are equal but for rounding."""
    try:
        return bool(np.isclose(one, other, rtol=1e-4, atol=1e-6, equal_nan=True).all())
    except Exception:  # of texts, parts with names, and objects
        return repr(one) == repr(other)


def probe(
    function: Callable[..., Any],
    given: Step | Array | tuple[Any, ...],
    who: str,
    space: Space | None = None,
    kind: type[SkillweaveError] = SkillError,
) -> None:
    """Call a function for other numbers of environments than n, at its first call.

    Args:
        function: the user's, which has just returned the right shape for n environments.
        given: its argument, or arguments: a step, or arrays whose first axis has n rows.
        who: the function's name in messages.
        space: of its result for one environment; None: a number.
        kind: the type of the error: PolicyError if the function is a policy.

    Raises:
        SkillError: its result does not have a row for each environment; the message names it.
    """
    owner, name = _owner_and_name(function)
    arguments = given if isinstance(given, tuple) else (given,)
    n = _count(arguments[0])
    if not n or not first_time(owner, name, "for others"):
        return
    sizes = _other_sizes(arguments, n)
    certain = all(_has_rows(a, n) for a in arguments)
    fault = (_notes_of(owner) or {}).get(name)
    leaves = (space or discrete(2)).leaves
    with untouched(function):
        for m in sizes:
            rows = np.arange(m) % n
            try:
                answer = function(*(_taken(a, rows, n) for a in arguments))
            except (Exception, SystemExit) as error:
                if not certain:
                    return
                raise kind(
                    f"{who} answers for {n} environments, but for {m} it raised "
                    f"{error_text(error)}: {f'it {fault}' if fault else AXIS}"
                ) from error
            for path, leaf in leaves.items():
                part = answer
                for key in path:
                    part = part[int(key) if isinstance(part, tuple | list) else key]
                actual, wanted = np.shape(part), (m, *leaf.shape)
                if actual != wanted and certain:
                    raise kind(
                        f"{who} returned shape {actual} for {m} environments, but {wanted} was "
                        f"expected; for {n} its shape was right by chance: {AXIS}"
                    )


def _other_sizes(arguments: tuple[Any, ...], n: int) -> tuple[int, ...]:
    """Return numbers of environments that differ from n and from the sizes of all other axes."""
    arrays = [x for a in arguments for x in _values(a) if isinstance(x, np.ndarray)]
    taken = {n, *(size for x in arrays for size in (*x.shape[1:], *_sizes_in(x.dtype)))}
    free = (m for m in itertools.count(3) if m not in taken)
    first = next(free)
    return (first,) if n > MOST else (first, next(m for m in free if m > n))


def _sizes_in(dtype: np.dtype[Any]) -> Iterator[int]:
    for part, *_ in (dtype.fields or {}).values():
        yield from (*part.shape, *_sizes_in(part.base))


def _values(given: Any) -> Iterator[Any]:
    """Yield all values in an argument: of a step its arrays and the values of its info."""
    if is_dataclass(given):
        for field in fields(given):
            yield from _values(getattr(given, field.name))
    elif isinstance(given, Mapping):
        for value in given.values():
            yield from _values(value)
    else:
        yield given


def _count(given: Any) -> int:
    """Return the number of environments of an argument."""
    return next((len(x) for x in _values(given) if isinstance(x, np.ndarray) and x.ndim), 0)


def _has_rows(given: Any, n: int) -> bool:
    """Return whether rows can be selected in all values of an argument, so no list in an info."""
    plain = bool | int | float | str | None | np.generic
    return all(
        isinstance(value, plain) or (isinstance(value, np.ndarray) and value.shape[:1] == (n,))
        for value in _values(given)
    )


def _taken(given: Any, rows: Array, n: int, factor: float = 1.0) -> Any:
    """Return the rows of an argument times ``factor``; values without rows do not change."""
    if is_dataclass(given):
        parts = {f.name: _taken(getattr(given, f.name), rows, n, factor) for f in fields(given)}
        kind: Any = type(given)
        return kind(**parts)
    if isinstance(given, Mapping):
        part = {key: _taken(value, rows, n, factor) for key, value in given.items()}
        return with_missing(part, given, len(rows))
    if isinstance(given, np.ndarray) and given.shape[:1] == (n,):
        taken = given[rows]
        if factor != 1.0:
            taken = taken * np.float32(factor) if taken.dtype.kind == "f" else np.zeros_like(taken)
        return read_only(taken)
    return given


@contextmanager
def untouched(thing: Any) -> Iterator[Spaces]:
    """Restore the global random streams, and the attributes of objects, after the block.

    Args:
        thing: a function or an object of the user.

    Yields:
        The attributes of each object, and their values before.
    """
    spaces = [(space, dict(space)) for space in _spaces(thing, {})]
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    torch = sys.modules.get("torch")
    state = None if torch is None else torch.get_rng_state()
    try:
        for space, values in spaces:
            space.update({name: _copied(value) for name, value in values.items()})
        yield spaces
    finally:
        for space, values in spaces:
            for name in space.keys() - values.keys():
                del space[name]
            space.update(values)
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        if torch is not None:
            torch.set_rng_state(state)


def _spaces(thing: Any, known: dict[int, Any], depth: int = DEPTH) -> Iterator[dict[str, Any]]:
    """Yield the attributes of the user's objects in a function or an object, and its dicts.

    Args:
        known: the objects that were searched, by ``id``.
    """
    thing, _ = _owner_and_name(thing)
    kinds = type(thing).__mro__
    if id(thing) in known:
        return
    known[id(thing)] = thing
    if isinstance(thing, types.FunctionType):
        if not is_own_code(thing):
            return
        space = {}
        with suppress(ValueError):  # of empty cells
            outside = inspect.getclosurevars(thing)
            space = {**outside.globals, **outside.nonlocals}
    elif is_own_code(kinds[0]) and not any(x.__module__.startswith(OTHERS) for x in kinds):
        space = getattr(thing, "__dict__", {})
        yield space
    elif isinstance(thing, dict) and len(thing) < MOST:
        space = thing
        yield space
    else:
        return
    for value in list(space.values()) if depth else ():
        yield from _spaces(value, known, depth - 1)


def _copied(value: Any) -> Any:
    """Return a copy of a value that may change in place; of others the value itself."""
    try:
        return copy.deepcopy(value) if isinstance(value, CHANGING) else value
    except Exception:  # it cannot be copied
        return value
