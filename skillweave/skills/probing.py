"""Tests of each user's function at its first calls.

A function that ignores the axis of the environments may return the right shape by chance:
``step.next_obs[0]`` has four numbers for four environments of CartPole. So the function is also
called with rows of its first call, repeated or cut to 3 and to more environments. Methods of skills
are also called with the same rows again: where they keep a state of their own, they answer
otherwise. A function may also have the right shape and mix up environments, as ``step.goal[0]``
does. So it is called with copies of single rows, whose answers must be those in the batch.
Afterwards, the random streams of Python, NumPy, torch, and of the function's object and module, are
restored.
"""

from __future__ import annotations

import copy
import inspect
import itertools
import random
import sys
import types
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np
from gymnasium import Space

from skillweave.errors import SkillError, SkillweaveError
from skillweave.messages import error_text, short
from skillweave.skills.goal_spaces import parts_of
from skillweave.types import Array, Step, read_only

MOST = 256
"""The most environments at which a function is also called with more of them."""
AXIS = (
    "the first axis of every array is that of the environments: step.next_obs[:, 0], obs[:, 0], "
    "axis=1"
)
"""Advice in messages."""
OWN_ROW = (
    "The first axis of every array is that of the environments: write step.goal[:, 0], not "
    "step.goal[0]; obs[:, 2], not obs[0, 2]; np.linalg.norm(x, axis=1), not np.linalg.norm(x)"
)
"""Advice where a function mixes up environments."""
COMPARED_CALLS = tuple(2**k for k in range(11))
"""The calls with several environments whose answers are compared with those for single rows."""
VARIED_CALLS = 16
"""The first calls that answer both yes and no are compared, too."""
COMPARED_ROWS = 8
"""The most rows of a call that are compared."""
REPEATS = 5
"""How often a wrong row is compared again before the function is refused."""
GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)
CHANGING = (
    dict,
    list,
    set,
    np.ndarray,
    *GENERATORS,
)
"""Kinds of attributes that a method may change in place."""


class Seen:
    """Objects, and names of their functions, that were tested in this process."""

    def __init__(self) -> None:
        self._names: dict[int, tuple[weakref.ref[Any], dict[str, int]]] = {}

    def first_time(self, owner: Any, name: str) -> bool:
        """Return whether this is the first call with these arguments."""
        return self.number(owner, name) == 1

    def number(self, owner: Any, name: str) -> int:
        """Return the number of this call with these arguments, from 1; 0: it is not known."""
        key = id(owner)
        if (entry := self._names.get(key)) is not None:
            number = entry[1][name] = entry[1].get(name, 0) + 1
            return number
        try:
            reference = weakref.ref(owner, lambda _: self._names.pop(key, None))
        except TypeError:  # of some objects written in C
            return 0
        self._names[key] = reference, {name: 1}
        return 1


_seen = Seen()
_compared = Seen()
_varied = Seen()


def probe(
    function: Callable[..., Any],
    given: Step | Array | tuple[Any, ...],
    n: int,
    who: str,
    answered: Any,
    space: Space[Any] | None = None,
    kind: type[SkillweaveError] = SkillError,
    *,
    repeats: bool = False,
    names: tuple[str, ...] = (),
) -> None:
    """Call a function for other rows than those of its call, at its first calls.

    Args:
        function: the user's, which has just returned the right shape for n environments.
        given: its argument, or arguments: a step, arrays whose first axis has n rows, generators.
        n: environments.
        who: the function's name in messages.
        answered: what it has returned, with a row for each environment; None: its answers may
            change, and depend on all rows.
        space: of its result for one environment; None: a number.
        kind: the type of the error: PolicyError if the function is a policy.
        repeats: it must return the same again.
        names: of its last arguments, which are given by name.

    Raises:
        SkillError: its result does not have a row for each environment, depends on the rows of
            others, or is another one when it is called again; the message names it.
    """
    if not n:
        return
    owner, name = getattr(function, "__self__", function), getattr(function, "__name__", "")
    first = _seen.first_time(owner, name)
    number = 0 if answered is None or n == 1 else _compared.number(owner, name)
    compares = number in COMPARED_CALLS or (
        number > 0 and _varies(answered) and _varied.number(owner, name) <= VARIED_CALLS
    )
    if not first and not compares:
        return
    arguments = given if isinstance(given, tuple) else (given,)
    sizes = _other_sizes(n, set(itertools.chain.from_iterable(_sizes(a, n) for a in arguments)))
    certain = all(_has_rows(a, n) for a in arguments)
    with randomness_kept(_generators_of(function)):
        arguments = tuple(copy.deepcopy(a) if isinstance(a, GENERATORS) else a for a in arguments)
        function = _with_names(_on_copy(function), names)
        if first and repeats:
            _check_again(function, arguments, answered, who)
        for m in sizes if first else ():
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
        if certain and compares:

            def of_rows(rows: Array) -> Any:
                return function(*(_taken(a, rows, n) for a in arguments))

            rows = _rows_to_compare(answered, n, number)
            if (wrong := _mixed_row(of_rows, answered, n, sizes[0], rows, space)) is not None:
                row, in_batch, alone = wrong
                raise kind(
                    f"{who} mixes up environments: it answers {in_batch} for row {row} of {n} "
                    f"environments, but {alone} where all rows are copies of this one. {OWN_ROW}"
                )


def _varies(answered: Any) -> bool:
    """Return whether there are both yes and no among answers (n,)."""
    flags = isinstance(answered, np.ndarray) and answered.dtype == bool
    return flags and bool(answered.any()) and not answered.all()


def _rows_to_compare(answered: Any, n: int, number: int) -> Array:
    """Return rows at random, and rows with the rarest answers, of a call of this number."""
    rows = np.random.default_rng(number).permutation(n)
    some = rows[: COMPARED_ROWS // 2]
    if not _varies(answered):
        return rows[:COMPARED_ROWS]
    rare = answered[rows] == (answered.mean() < 0.5)
    return np.concatenate([some, rows[rare][: COMPARED_ROWS // 2]])


def _mixed_row(
    of_rows: Callable[[Array], Any],
    answered: Any,
    n: int,
    m: int,
    rows: Array,
    space: Space[Any] | None,
) -> tuple[int, str, str] | None:
    """Return a row whose answer depends on others, and its answer in the batch and alone.

    None: there is no such row, or the function is random, or has a state.

    Args:
        of_rows: calls the function with these of n rows.
        answered: what it has returned for the n rows.
        m: the number of copies of a row with which it is called.
        rows: those that are compared.
        space: of its result for one environment; None: a number.
    """
    in_batch = _flat_leaves(answered, n, space)

    def differs(row: int, copies: int) -> tuple[str, str] | None:
        """Return the answers for a row where all of its copies have another one."""
        alone = _flat_leaves(of_rows(np.full(copies, row)), copies, space)
        for batch, single in zip(in_batch, alone, strict=True):
            if not _same(single, batch[[row]], batch).any():
                return short(_plain(batch[row])), short(_plain(single[0]))
        return None

    try:
        for row in map(int, rows):
            if differs(row, m) is None:
                continue
            for _ in range(REPEATS):
                again = _flat_leaves(of_rows(np.arange(n)), n, space)
                if not all(_same(a, b, b).all() for a, b in zip(again, in_batch, strict=True)):
                    return None
                # As many rows as in the batch: sums of few rows may be rounded otherwise.
                if (found := differs(row, n)) is None:
                    break
            else:
                assert found is not None
                return row, *found
    except (Exception, SystemExit):  # it fails now and then: this is said elsewhere
        return None
    return None


def _flat_leaves(answer: Any, n: int, space: Space[Any] | None) -> list[Array]:
    """Return the parts of a result for n environments, each (n, size)."""
    return [np.asarray(part).reshape(n, -1) for part, _ in _leaves(answer, space)]


def _same(one: Array, other: Array, all_rows: Array) -> Array:
    """Return the rows (n,) that are equal but for rounding; ``all_rows`` give its size."""
    if one.dtype.kind not in "fiub" or other.dtype.kind not in "fiub":
        equal: Array = np.broadcast_to(one == other, one.shape)
    else:
        numbers = np.abs(all_rows.astype(np.float64))
        rounding = 1e-6 * max(1.0, numbers[np.isfinite(numbers)].max(initial=0.0))
        x, y = one.astype(np.float64), other.astype(np.float64)
        equal = np.isclose(x, y, 1e-4, rounding, equal_nan=True)
    return cast(Array, equal.all(axis=1))


def _plain(row: Array) -> Any:
    """Return a row of a result in Python's numbers, which are easier to read."""
    values = [float(f"{x:.6g}") if isinstance(x, float) else x for x in row.tolist()]
    return values[0] if len(values) == 1 else values


def _with_names(function: Callable[..., Any], names: tuple[str, ...]) -> Callable[..., Any]:
    """Return a function of positions alone, whose last arguments are given by these names."""
    if not names:
        return function

    def by_position(*arguments: Any) -> Any:
        places = len(arguments) - len(names)
        return function(*arguments[:places], **dict(zip(names, arguments[places:], strict=True)))

    return by_position


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
    plain = bool, int, float, str, type(None), np.generic, *GENERATORS
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
    """Return a method, or an object that is called, of a copy, so that its state does not change.

    Counters, collections and generators are copied; other objects that it holds are not.
    """
    method = isinstance(function, types.MethodType)
    owner = function.__self__ if isinstance(function, types.MethodType) else function
    if not method and (inspect.isroutine(function) or isinstance(function, type)):
        return function
    try:
        twin = copy.copy(owner)
        for name, value in vars(twin).items():
            if isinstance(value, CHANGING):
                vars(twin)[name] = copy.deepcopy(value)
    except Exception:  # it cannot be copied
        return function
    if isinstance(function, types.MethodType):
        return types.MethodType(function.__func__, twin)
    return cast(Callable[..., Any], twin)


def _generators_of(function: Callable[..., Any]) -> list[Any]:
    """Return the random generators of a function's object, module and closure."""
    owner, plain = getattr(function, "__self__", function), getattr(function, "__func__", function)
    found = [*getattr(owner, "__dict__", {}).values()]
    found += getattr(plain, "__globals__", {}).values()
    for cell in getattr(plain, "__closure__", None) or ():
        with suppress(ValueError):  # it is empty
            found.append(cell.cell_contents)
    return [x for x in found if isinstance(x, GENERATORS)]


@contextmanager
def randomness_kept(generators: Sequence[Any] = ()) -> Iterator[None]:
    """Restore the global random streams, and these generators, after the block."""
    states = [_state_of(generator) for generator in generators]
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
            _set_state(generator, of_generator)


def _state_of(generator: Any) -> Any:
    if isinstance(generator, np.random.Generator):
        return generator.bit_generator.state
    if isinstance(generator, np.random.RandomState):
        return generator.get_state()
    return generator.getstate()


def _set_state(generator: Any, state: Any) -> None:
    if isinstance(generator, np.random.Generator):
        generator.bit_generator.state = state
    elif isinstance(generator, np.random.RandomState):
        generator.set_state(state)
    else:
        generator.setstate(state)
