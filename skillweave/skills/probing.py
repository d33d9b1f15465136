"""Tests of each user's function at its first call.

A function that ignores the axis of the environments may return the right shape by chance:
``step.next_obs[0]`` has four numbers for four environments of CartPole. So the function is also
called with rows of its first call, repeated or cut to 3 and to more environments. Methods of skills
are also called with the same rows again: where they keep a state of their own, they answer
otherwise. Afterwards, the random streams of Python, NumPy, torch and the method's object are
restored.
"""

from __future__ import annotations

import copy
import itertools
import random
import sys
import types
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from gymnasium import Space

from skillweave.errors import SkillError, SkillweaveError
from skillweave.messages import error_text
from skillweave.skills.goal_spaces import parts_of
from skillweave.types import Array, Step, read_only

MOST = 256
"""The most environments at which a function is also called with more of them."""
AXIS = (
    "the first axis of every array is that of the environments: step.next_obs[:, 0], obs[:, 0], "
    "axis=1"
)
"""Advice in messages."""
CHANGING = (
    dict,
    list,
    set,
    np.ndarray,
    random.Random,
    np.random.Generator,
    np.random.RandomState,
)
"""Kinds of attributes that a method may change in place."""


class Seen:
    """Objects, and names of their functions, that were tested in this process."""

    def __init__(self) -> None:
        self._names: dict[int, tuple[weakref.ref[Any], set[str]]] = {}

    def first_time(self, owner: Any, name: str) -> bool:
        """Return whether this is the first call with these arguments."""
        key = id(owner)
        if (entry := self._names.get(key)) is not None:
            if name in entry[1]:
                return False
            entry[1].add(name)
            return True
        try:
            reference = weakref.ref(owner, lambda _: self._names.pop(key, None))
        except TypeError:  # of some objects written in C
            return False
        self._names[key] = reference, {name}
        return True


_seen = Seen()


def probe(
    function: Callable[..., Any],
    given: Step | Array | tuple[Any, ...],
    n: int,
    who: str,
    space: Space[Any] | None = None,
    kind: type[SkillweaveError] = SkillError,
    answered: Array | None = None,
) -> None:
    """Call a function for other numbers of environments than n, at its first call.

    Args:
        function: the user's, which has just returned the right shape for n environments.
        given: its argument, or arguments: a step, or arrays whose first axis has n rows.
        n: environments.
        who: the function's name in messages.
        space: of its result for one environment; None: a number.
        kind: the type of the error: PolicyError if the function is a policy.
        answered: (n,) what it has returned, and must return again; None: it may change.

    Raises:
        SkillError: its result does not have a row for each environment, or is another one when it
            is called again; the message names it.
    """
    owner = getattr(function, "__self__", function)
    if not n or not _seen.first_time(owner, getattr(function, "__name__", "")):
        return
    arguments = given if isinstance(given, tuple) else (given,)
    sizes = _other_sizes(n, set(itertools.chain.from_iterable(_sizes(a, n) for a in arguments)))
    certain = all(_has_rows(a, n) for a in arguments)
    with randomness_kept():
        function = _on_copy(function)
        if answered is not None:
            _check_again(function, arguments, answered, who)
        for m in sizes:
            rows = np.arange(m) % n
            try:
                answer = function(*(_taken(a, rows, n) for a in arguments))
            except (Exception, SystemExit) as error:
                if not certain:
                    return
                raise kind(
                    f"{who} answers for {n} environments, but for {m} it raised "
                    f"{error_text(error)}: {AXIS}"
                ) from error
            for part, shape in _leaves(answer, space):
                actual, wanted = np.shape(part), (m, *shape)
                if actual != wanted and certain:
                    raise kind(
                        f"{who} returned shape {actual} for {m} environments, but {wanted} was "
                        f"expected; for {n} its shape was right by chance: {AXIS}"
                    )


def _leaves(answer: Any, space: Space[Any] | None) -> Iterator[tuple[Any, tuple[int, ...]]]:
    """Yield the parts of a result of ``space``, and the shape of each for one environment."""
    inner = None if space is None else parts_of(space)
    if inner is None:
        yield answer, () if space is None else space.shape or ()
        return
    for i, (name, part) in enumerate(inner.items()):
        yield from _leaves(answer[i if isinstance(answer, tuple | list) else name], part)


def _check_again(
    function: Callable[..., Any], arguments: tuple[Any, ...], answered: Array, who: str
) -> None:
    """Raise a SkillError where a function keeps a state that its answers depend on.

    A function may draw random numbers: then its answers are compared from the same ones.
    """
    n = len(answered)
    with randomness_kept(_generators_of(function)):
        first = _answer(function, arguments, n)
    again = _answer(function, arguments, n)
    otherwise = _answer(function, arguments, n)  # from other random numbers
    if first is None or again is None or otherwise is None:
        return  # called with the same rows, it fails now and then: this is said elsewhere
    if _alike(first, again) and (_alike(first, answered) or not _alike(first, otherwise)):
        return
    before, after = (first, again) if _alike(answered, first) else (answered, first)
    row = int(np.flatnonzero(~_close(before, after))[0])
    raise SkillError(
        f"{who} answers {before[row]:g}, and {after[row]:g} when it is asked about the same again, "
        "so it keeps a state of its own. Steps are judged in any order and number, and later than "
        "they were made: compute the answer from the argument alone, and let the environment, or a "
        "wrapper, put what must be remembered into the observation or info. Where a reward should "
        "change (a bonus for what was seldom seen), say so in its class: reward_changes = True"
    )


def _answer(function: Callable[..., Any], arguments: tuple[Any, ...], n: int) -> Array | None:
    """Return the answer (n,) of a function as float64; None where it fails."""
    try:
        return np.asarray(function(*arguments)).astype(np.float64).reshape(n)
    except (Exception, SystemExit):
        return None


def _alike(one: Array, other: Array) -> bool:
    return bool(_close(one, other).all())


def _close(one: Array, other: Array) -> Array:
    """Return where two answers are equal but for rounding, (n,) bool."""
    close: Array = np.isclose(one, other, rtol=1e-4, atol=1e-6, equal_nan=True)
    return close


def _other_sizes(n: int, taken: set[int]) -> tuple[int, ...]:
    """Return numbers of environments that differ from n and from the sizes of all other axes."""
    free = (m for m in itertools.count(3) if m != n and m not in taken)
    first = next(free)
    if n > MOST:
        return (first,)
    return first, next(m for m in free if m > n)


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


def _sizes(given: Any, n: int) -> Iterator[int]:
    """Yield the sizes of all axes of an argument but the first."""
    for array in _values(given):
        if isinstance(array, np.ndarray):
            yield from array.shape[1:]
            yield from _sizes_of_fields(array.dtype)


def _sizes_of_fields(dtype: np.dtype[Any]) -> Iterator[int]:
    for part, *_ in (dtype.fields or {}).values():
        yield from part.shape
        yield from _sizes_of_fields(part.base)


def _has_rows(given: Any, n: int) -> bool:
    """Return whether rows can be selected in all values of an argument, so no list in an info."""
    plain = bool | int | float | str | None | np.generic
    return all(
        isinstance(value, plain) or (isinstance(value, np.ndarray) and value.shape[:1] == (n,))
        for value in _values(given)
    )


def _taken(given: Any, rows: Array, n: int) -> Any:
    """Return the rows of an argument; values without rows do not change."""
    if is_dataclass(given):
        parts = {f.name: _taken(getattr(given, f.name), rows, n) for f in fields(given)}
        kind: Any = type(given)
        return kind(**parts)
    if isinstance(given, Mapping):
        return {key: _taken(value, rows, n) for key, value in given.items()}
    if isinstance(given, np.ndarray) and given.shape[:1] == (n,):
        return read_only(given[rows])
    return given


def _on_copy(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method of a copy of its object, so counters and generators do not change."""
    if not isinstance(function, types.MethodType):
        return function
    try:
        twin = copy.copy(function.__self__)
        for name, value in vars(twin).items():
            if isinstance(value, CHANGING):
                vars(twin)[name] = copy.deepcopy(value)
    except Exception:  # it cannot be copied
        return function
    return types.MethodType(function.__func__, twin)


def _generators_of(function: Callable[..., Any]) -> list[Any]:
    """Return the random generators of a method's object."""
    found = vars(getattr(function, "__self__", None) or types.SimpleNamespace()).values()
    return [x for x in found if isinstance(x, (np.random.Generator, random.Random))]


@contextmanager
def randomness_kept(generators: Sequence[Any] = ()) -> Iterator[None]:
    """Restore the global random streams, and these generators, after the block."""
    states = [
        g.bit_generator.state if isinstance(g, np.random.Generator) else g.getstate()
        for g in generators
    ]
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    torch = sys.modules.get("torch")
    state = None if torch is None else torch.get_rng_state()
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        if torch is not None:
            torch.set_rng_state(state)
        for generator, of_generator in zip(generators, states, strict=True):
            if isinstance(generator, np.random.Generator):
                generator.bit_generator.state = of_generator
            else:
                generator.setstate(of_generator)
