"""Looks at users' functions: an answer about an environment must depend on that one alone.

At some of its calls a function is called twice more: with other rows (``B``), and with the same rows
again, whose whole numbers are widened to int64 (``C``). A difference has one of these causes:

- A result of the right shape by chance: ``step.next_obs[0]`` has four numbers for four environments
  of CartPole.
- Statistics over the environments: ``obs - obs.mean(0)``.
- A state that the function keeps, or random numbers.
- Bytes that wrap around: 3 - 4 is 255.

Further calls, which find the cause, are made only after a difference. Each look leaves the random
generators, and the attributes of the user's objects, as they were.
"""

from __future__ import annotations

import copy
import inspect
import itertools
import pickle
import random
import sys
import types
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from skillweave._internal.messages import error_text
from skillweave._internal.notices import notice
from skillweave._internal.tracebacks import is_own_code
from skillweave.errors import SkillError, SkillweaveError
from skillweave.types import Array, read_only

LOOKS = {4**i: i for i in range(6)}
"""The calls at which a function is looked at, and how many looks there were before.

The first rows may be equal, may be of one environment, or may have no difference that wraps."""
MOST_BYTES = 1 << 22
"""The most bytes of rows with which a function is called again, unless 8 rows have more."""
AXIS = (
    "the first axis of every array is that of the environments: step.next_obs[:, 0], obs[:, 0], "
    "axis=1"
)
"""Advice in messages."""
OTHERS = ("torch", "gymnasium")
"""Packages whose objects may keep a state: modules and environments."""
CHANGING = (dict, list, set, deque, np.ndarray)
"""Kinds of attributes that a function may change in place."""
MOST_KEYS = 256
"""The most keys of a dict that is searched for a state."""
DEPTH = 3
"""The most objects between a function and an attribute that it writes."""
READS_BYTES = {"tobytes", "view", "frombuffer", "unpackbits", "packbits", "dtype"}
"""Names in functions whose answer depends on the type of whole numbers on purpose."""
REMEMBER = (
    "compute the answer from the argument alone, and let the environment, or a wrapper, put what "
    "must be remembered into the observation or info. A policy may have a state: "
    "sw.from_function(function, state=shape). Where a reward should change (a bonus for what was "
    "seldom seen), say so in its class: reward_changes = True"
)
"""Advice about functions that keep a state of their own."""


# Notes about functions -------------------------------------------------------------------------

_notes: dict[int, tuple[weakref.ref[Any], dict[Any, Any]]] = {}
_mode: ContextVar[Literal["usual", "examples", "off"]] = ContextVar("_mode", default="usual")


def _notes_of(owner: Any) -> dict[Any, Any] | None:
    """Return this process's notes about an object; None: it can have none."""
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


def _owner_and_name(function: Any) -> tuple[Any, str]:
    """Return what the notes about a function stand under."""
    while isinstance(function, partial):
        function = function.func
    return getattr(function, "__self__", function), getattr(function, "__name__", "")


def look_at(call: Call, judges: bool | None) -> Look | None:
    """Return a look at a function, before it is called; None: none is due.

    Args:
        judges: its answer to the same must never change; None: it may keep a state.
    """
    mode = _mode.get()
    owner, name = _owner_and_name(call.owner or call.function)
    if mode == "off" or str(getattr(owner, "__module__", "")).startswith("skillweave."):
        return None
    if (notes := _notes_of(owner)) is None:
        return None
    key = name, mode
    count = notes.get(key, 0) + 1
    if count in LOOKS and not call.n:
        return None
    notes[key] = count
    repeated = count > 1 and (judges is None or mode == "examples")
    if count not in LOOKS or repeated or (name, "changes") in notes:
        return None
    return Look(call, judges, LOOKS[count], wide=mode == "usual")


# Calls -----------------------------------------------------------------------------------------


@dataclass
class Call:
    """A call of a user's function, which can be repeated with other rows.

    Args:
        given: its arguments; their arrays have a row for each environment.
        named: arguments by name, of the same kind.
        fixed: further arguments, which are for all rows.
    """

    function: Callable[..., Any]
    given: tuple[Any, ...] = ()
    named: Mapping[str, Any] = field(default_factory=dict)
    fixed: tuple[Any, ...] = ()
    owner: Any = None
    """The user's object, where the function is this library's."""

    def __call__(self) -> Any:
        """Return the answer."""
        return self.function(*self.given, *self.fixed, **self.named)

    def again(self, change: Callable[[Any], Any]) -> Any:
        """Return the answer for changed arguments."""
        given, named = changed((self.given, dict(self.named)), change)
        return self.function(*given, *self.fixed, **named)

    @property
    def arrays(self) -> list[Array]:
        """The arrays in its arguments, without those in infos."""
        return [x for x in _values((self.given, self.named)) if isinstance(x, np.ndarray)]

    @property
    def n(self) -> int:
        """The number of environments."""
        return next((len(x) for x in self.arrays if x.ndim), 0)

    def rows(self, rows: Array) -> Callable[[Any], Any]:
        """Return the change that takes rows of arrays; what has none does not change."""
        n = self.n

        def take(x: Any) -> Any:
            fits = isinstance(x, np.ndarray) and x.shape[:1] == (n,)
            return read_only(x[rows]) if fits else x

        return take


def changed(given: Any, change: Callable[[Any], Any]) -> Any:
    """Return arguments with ``change`` of all values in them, also of those in infos."""
    if is_dataclass(given):
        parts = {f.name: changed(getattr(given, f.name), change) for f in fields(given)}
        kind: Any = type(given)
        return kind(**parts)
    if type(given) is dict:
        return {key: changed(value, change) for key, value in given.items()}
    if isinstance(given, tuple):
        return tuple(changed(value, change) for value in given)
    return _Info(given, change) if isinstance(given, Mapping) else change(given)


@dataclass
class _Info(Mapping[Any, Any]):
    """An info whose values are changed when they are read."""

    whole: Mapping[Any, Any]
    change: Callable[[Any], Any]

    def __getitem__(self, key: Any) -> Any:
        return changed(self.whole[key], self.change)

    def __contains__(self, key: object) -> bool:
        return key in self.whole

    def get(self, key: Any, default: Any = None) -> Any:
        """Return a value that the environments give now; of other keys the default."""
        return self[key] if key in self.whole else default

    def __iter__(self) -> Iterator[Any]:
        return iter(self.whole)

    def __len__(self) -> int:
        return len(self.whole)


def _values(given: Any) -> Iterator[Any]:
    """Yield all values in arguments, without those in infos."""
    if is_dataclass(given):
        for part in fields(given):
            if part.name != "info":
                yield from _values(getattr(given, part.name))
    elif isinstance(given, tuple | dict):
        for value in given.values() if isinstance(given, dict) else given:
            yield from _values(value)
    else:
        yield given


def _widened(x: Any, kind: str) -> Any:
    """Return whole numbers as int64 (``kind`` "wide"), or their bytes with the other sign."""
    if not isinstance(x, np.ndarray) or x.dtype == (to := _other_type(x.dtype, kind)):
        return x
    return read_only(x.astype(to) if kind == "wide" else np.ascontiguousarray(x).view(to))


def _other_type(dtype: np.dtype[Any], kind: str) -> np.dtype[Any]:
    if dtype.names:
        parts = [(name, _other_type(dtype[name], kind)) for name in dtype.names]
        return np.dtype(parts, align=dtype.isalignedstruct)
    if dtype.subdtype:
        return np.dtype((_other_type(dtype.subdtype[0], kind), dtype.shape))
    if dtype.kind not in "iu":
        return dtype
    if kind == "wide":
        return np.dtype(np.int64)
    return np.dtype(f"{'u' if dtype.kind == 'i' else 'i'}{dtype.itemsize}")


# Answers ---------------------------------------------------------------------------------------


def parts_of(answer: Any) -> dict[str, Array]:
    """Return the arrays in an answer, by name: a dict or a tuple has several; {}: it is odd."""
    several: Iterable[tuple[Any, Any]] = [("", answer)]
    if isinstance(answer, Mapping):
        several = answer.items()
    elif isinstance(answer, tuple) and any(isinstance(x, np.ndarray | Mapping) for x in answer):
        several = enumerate(answer)
    found: dict[str, Array] = {}
    for name, part in several:
        if isinstance(part, Mapping | tuple) and part is not answer:
            found |= {f"{name}.{inner}": x for inner, x in parts_of(part).items()}
            continue
        try:
            found[str(name)] = np.asarray(part)
        except Exception:  # lists of unequal lengths, tensors with gradients
            return {}
    return {
        f"{name}.{inner}" if inner else name: x[inner] if inner else x
        for name, x in found.items()
        for inner in x.dtype.names or ("",)
    }


def largest_difference(
    answer: Mapping[str, Array], other: Mapping[str, Array], rows: Array, close: float = 1e-3
) -> tuple[Any, Any, int] | None:
    """Return the answers that differ most, and their row; None: all are equal but for rounding.

    Args:
        rows: of the ``answer``, those of which ``other`` is.
        close: the largest difference that is rounding, for a number of size 1.
    """
    for name, x in answer.items():
        one, two = x[rows].reshape(len(rows), -1), other[name].reshape(len(rows), -1)
        if one.dtype.kind == two.dtype.kind == "f" or {one.dtype.kind, two.dtype.kind} == {
            "f",
            "i",
        }:
            one, two = one.astype(np.float64), two.astype(np.float64)
            size = np.abs(one, where=np.isfinite(one), out=np.zeros(one.shape))
            least = 1e-6 + close * (size + 0.1 * size.max(initial=0.0))
            differs = ~(
                (np.abs(one - two) <= least) | (one == two) | (np.isnan(one) & np.isnan(two))
            )
        else:
            differs = np.asarray(one != two, bool)
        if differs.any():
            places = [tuple(place) for place in np.argwhere(differs).tolist()]
            if one.dtype.kind == two.dtype.kind == "f":
                places.sort(key=lambda at: (-abs(one[at] - two[at]), -abs(one[at])))
            at = places[0]
            return one[at], two[at], int(rows[at[0]])
    return None


def other_rows(answer: Mapping[str, Array], n: int, taken: set[int], most: int, look: int) -> Array:
    """Return rows in another order and number, among which statistics are likely to be others.

    They are rows with the same answer, if many have it: where "above the mean" is true, it is false
    for the least of these rows alone. Else they are rows below the largest answers, or above the
    smallest, without both ends, so that the mean and the extremes are others.

    Args:
        taken: numbers of rows that would not show a wrong axis.
        look: the number of looks before; every second one begins at the other end.
    """
    order, equal = np.arange(n), np.ones(n, bool)
    with suppress(TypeError):  # of objects
        values = next(iter(answer.values())).reshape(n, -1)[:, 0]
        order = np.argsort(values, kind="stable")
        equal = values[order] == values[np.roll(order, 1)]
    if look % 2:
        order, equal = order[::-1], np.roll(equal[::-1], 1)
    starts = np.flatnonzero(~equal)
    if len(starts):
        lengths = np.diff([*starts, n])
        longest = int(lengths.argmax())
        group = order[starts[longest] : starts[longest] + lengths[longest]]
        group = group if 4 * len(group) >= n else order[n // 8 : max(5 * n // 8, 1)]
    else:  # all answers are equal
        group = order[look % n :][:1]
    group, size = group[::-1], min(len(group), most)
    sizes = itertools.chain(range(size, 2, -1), itertools.count(max(size, 3)))
    count = next(m for m in sizes if m not in taken)
    return group[np.arange(count) % len(group)]


# Looks -----------------------------------------------------------------------------------------


class Look:
    """A comparison of an answer with those to other questions.

    It is made before the function is called, since it holds what was so before.

    Args:
        judges: see ``look_at``.
        before: the number of looks before.
        wide: whole numbers are widened: the rows are an environment's, not examples.
    """

    def __init__(self, call: Call, judges: bool | None, before: int, *, wide: bool) -> None:
        self._call, self._judges, self._before, self._wide = call, judges, before, wide
        self._state = State(call.owner or call.function, call.fixed)

    def check(self, answer: Any, who: str, kind: type[SkillweaveError]) -> None:
        """Compare the answer that the function has just given.

        Args:
            who: its name in messages.
            kind: the type of an error.

        Raises:
            SkillError: its answer does not depend on one environment alone.
        """
        call, n = self._call, self._call.n
        parts = parts_of(answer)
        if not parts or any(x.shape[:1] != (n,) for x in parts.values()):
            return  # the caller says so
        self._n, self._parts, self._who, self._kind = n, parts, who, kind
        size = sum(x.nbytes for x in call.arrays) // n
        self._most = int(np.clip(MOST_BYTES // max(size, 1), 8, 4096))
        state = self._state
        with state.restored_afterwards(), np.errstate(all="ignore"):
            self._written, self._random = state.written(), state.random()
            self._ask_others()

    def _ask_others(self) -> None:
        call, every = self._call, np.arange(self._n)
        axes = {self._n, *(size for x in call.arrays for size in _sizes_in(x))}
        rows = other_rows(self._parts, self._n, axes, self._most, self._before)
        other = self._checked_shape(rows)
        if self._judges is None:
            return
        few, states = every[: self._most], False
        narrow = sorted({t for x in call.arrays for t in _narrow_types(x.dtype)})
        narrow = narrow if self._wide else []
        differs = self._difference(few, "wide" if narrow else "")
        if differs and (narrow or len(few) < self._n):
            wide, differs = differs, self._difference(every)
            if narrow and not differs and not self._difference(few):
                self._notice_wrap(wide, narrow[0])
        if differs:
            self._refuse_state(differs)
            states = not self._difference(few, alone=True)
        elif self._written and not self._before:
            states = self._answers_by_state()
        if differs or states:
            owner, name = _owner_and_name(call.owner or call.function)
            (_notes_of(owner) or {})[name, "changes"] = True
        if states and self._written:
            notice(f"{self._who} {self._fault}")
        elif other and not differs and not self._random:
            self._refuse_statistics(largest_difference(self._parts, other, rows))

    def _checked_shape(self, rows: Array) -> dict[str, Array] | None:
        """Return the answer for other rows; None: nothing follows from it.

        Raises:
            SkillError: it failed, or has no row for each of them.
        """
        n, m, certain = self._n, len(rows), []

        def take(x: Any) -> Any:
            fits = isinstance(x, np.ndarray) and x.shape[:1] == (n,)
            if not fits and not isinstance(x, bool | int | float | str | None | np.generic):
                certain.append(False)  # such as a list in an info
            return read_only(x[rows]) if fits else x

        self._state.prepare()
        try:
            answer = self._call.again(take)
        except (Exception, SystemExit) as error:
            if certain:
                return None
            fault = f"it {self._fault}" if self._written else AXIS
            raise self._kind(
                f"{self._who} answers for {n} environments, but for {m} it raised "
                f"{error_text(error)}: {fault}"
            ) from error
        parts = parts_of(answer)
        for name, x in self._parts.items():
            actual = parts[name].shape if name in parts else np.shape(answer)
            wanted = (m, *x.shape[1:])
            if actual != wanted:
                if certain:
                    return None
                raise self._kind(
                    f"{self._who} returned shape {actual} for {m} environments, but {wanted} was "
                    f"expected; for {n} its shape was right by chance: {AXIS}"
                )
        return None if certain else parts

    @property
    def _fault(self) -> str:
        return (
            f"writes {', '.join(self._written[:4])}, and answers by it. It runs on from one "
            f"episode into the next, and all environments share it: {REMEMBER}"
        )

    def _answer(
        self, rows: Array, kind: str = "", factor: float = 1.0, *, alone: bool = False
    ) -> dict[str, Array] | None:
        """Return the answer for some rows; None: it failed, or has another shape.

        Args:
            kind: see ``_widened``; "": no change.
            factor: of real numbers; other numbers become 0 unless it is 1.
            alone: the state is that of before the call; else it is that of now.
        """
        take = self._call.rows(rows)

        def change(x: Any) -> Any:
            x = take(x)
            if factor != 1.0 and isinstance(x, np.ndarray):
                x = read_only(x * np.float32(factor) if x.dtype.kind == "f" else np.zeros_like(x))
            return _widened(x, kind) if kind else x

        self._state.prepare(alone=alone)
        with suppress(Exception, SystemExit):
            parts = parts_of(self._call.again(change))
            shapes = {name: (len(rows), *x.shape[1:]) for name, x in self._parts.items()}
            if {name: x.shape for name, x in parts.items()} == shapes:
                return parts
        return None

    def _difference(
        self, rows: Array, kind: str = "", *, alone: bool = False
    ) -> tuple[Any, Any, int] | None:
        """Return where the answer is another one for some of the same rows; see ``_answer``."""
        answer = self._answer(rows, kind, alone=alone)
        if answer is None:
            return None
        return largest_difference(self._parts, answer, rows, 1e-2 if kind else 1e-3)

    def _answers_by_state(self) -> bool:
        """Return whether answers depend on the calls before, though repeated ones are the same."""
        every = np.arange(self._n)
        if self._most < self._n or self._difference(every, alone=True):
            return False  # the first difference is by random numbers of an unknown source
        factors = (0.0, 100.0, -100.0, 1.0)
        self._state.prepare()
        with self._state.kept():
            in_turn = [self._answer(every, factor=factor) for factor in factors]
        alone = [self._answer(every, factor=factor, alone=True) for factor in factors]
        return any(
            largest_difference(one, two, every) if one and two else bool(one) != bool(two)
            for one, two in zip(in_turn, alone, strict=True)
        )

    def _refuse_state(self, differs: tuple[Any, Any, int]) -> None:
        if self._judges:
            before, after, _ = differs
            raise SkillError(
                f"{self._who} answers {before:g}, and {after:g} when it is asked about the "
                "same again, so it keeps a state of its own. Steps are judged in any order and "
                f"number, and later than they were made: {REMEMBER}"
            )

    def _refuse_statistics(self, differs: tuple[Any, Any, int] | None) -> None:
        if differs is not None:
            one, two, row = differs
            raise self._kind(
                f"{self._who} answers {shown(one)} for environment {row}, but {shown(two)} for the "
                "same one beside other environments, so its answer depends on the others: let it "
                "use the numbers of one environment alone, without statistics over the first axis "
                "(mean, max, median, a sum, the order)"
            )

    def _notice_wrap(self, differs: tuple[Any, Any, int], narrow: str) -> None:
        if self._reads_bytes():
            return
        one, two, _ = differs
        notice(
            f"{self._who} answers {shown(one)}, but {shown(two)} for the same numbers as int64: a result does not fit into {narrow}, and wraps around. Convert the "
            "numbers before you compute with them: obs.astype(np.float32)"
        )

    def _reads_bytes(self) -> bool:
        """Return whether the function reads the bytes of numbers, as keys of a table for example.

        Then no number as int64 is a key, and all answers for them are alike.
        """
        if reads_bytes(self._call.function):
            return True
        few = np.arange(self._n)[: self._most]
        wide = self._answer(few, "wide") or {}
        alike = all((x == x[:1]).all() for x in wide.values())
        return alike and not self._difference(few, "other sign")


def shown(value: Any) -> str:
    """Return a value of an answer for messages."""
    value = getattr(value, "item", lambda: value)()
    return f"{value:.4g}" if isinstance(value, float) else repr(value)


def reads_bytes(function: Any, depth: int = 2) -> bool:
    """Return whether a function, or one that it calls, reads the bytes or the type of numbers."""
    while isinstance(function, partial):
        function = function.func
    function = getattr(function, "__func__", function)
    if not isinstance(function, types.FunctionType):
        function = getattr(type(function), "__call__", None)
        if not isinstance(function, types.FunctionType):
            return False
    codes = [function.__code__]
    for code in codes:
        codes += [x for x in code.co_consts if isinstance(x, types.CodeType)]
    if any(READS_BYTES.intersection(code.co_names) for code in codes):
        return True
    helpers: list[Any] = []
    with suppress(ValueError):  # of empty cells
        outside = inspect.getclosurevars(function)
        helpers = [*outside.globals.values(), *outside.nonlocals.values()]
    own = (x for x in helpers if isinstance(x, types.FunctionType) and is_own_code(x))
    return depth > 0 and any(reads_bytes(x, depth - 1) for x in own)


def _sizes_in(x: Array) -> Iterator[int]:
    yield from x.shape[1:]
    parts = [x.dtype]
    for dtype in parts:
        for part, *_ in (dtype.fields or {}).values():
            yield from part.shape
            parts.append(part.base)


def _narrow_types(dtype: np.dtype[Any]) -> Iterator[str]:
    """Yield the types of whole numbers in an array that are not int64."""
    for part, *_ in (dtype.fields or {}).values():
        yield from _narrow_types(part.base)
    if dtype.kind in "iu" and dtype != np.int64:
        yield str(dtype)


# State -----------------------------------------------------------------------------------------

Attributes = list[tuple[dict[str, Any], dict[str, Any]]]
"""The dicts of attributes of objects, and their values at one time."""


class State:
    """What a function may change: attributes of the user's objects, and random generators.

    Args:
        function: of the user; also an object.
        more: arguments, which may be generators.
    """

    def __init__(self, function: Any, more: tuple[Any, ...] = ()) -> None:
        found = list(_reachable(function, {}))
        self._spaces = [x for x in found if isinstance(x, dict)]
        self._generators = [x for x in found if not isinstance(x, dict)]
        self._generators += [x for x in more if isinstance(x, tuple(GENERATORS))]
        self._generators += _global_generators()
        self._before = self._copies()
        self._random_before = [*map(_random_state, self._generators)]
        self._after: Attributes = []
        self._keep = False

    def _copies(self) -> Attributes:
        return [(space, {k: _copied(v) for k, v in space.items()}) for space in self._spaces]

    def written(self) -> list[str]:
        """Return the names of the attributes that have changed."""
        return [
            str(name)
            for space, values in self._before
            for name, value in space.items()
            if not isinstance(value, tuple(GENERATORS)) and not _equal(value, values.get(name))
        ]

    def random(self) -> bool:
        """Return whether a generator was used."""
        now = [*map(_random_state, self._generators)]
        return pickle.dumps(now) != pickle.dumps(self._random_before)

    @contextmanager
    def restored_afterwards(self) -> Iterator[None]:
        """Restore all as it is now after the block, which may change it; looks are off in it."""
        originals = [(space, dict(space)) for space in self._spaces]
        generators = [_random_state(x) for x in self._generators]
        self._after = self._copies()
        mode = _mode.set("off")
        try:
            yield
        finally:
            _mode.reset(mode)
            _put(originals)
            for generator, state in zip(self._generators, generators, strict=True):
                _set_random_state(generator, state)

    def prepare(self, *, alone: bool = False) -> None:
        """Set the state of after the function's call, and generators as before it.

        Args:
            alone: the state of before the call.
        """
        if alone or not self._keep:
            _put(self._before if alone else self._after, _copied)
        for generator, state in zip(self._generators, self._random_before, strict=True):
            _set_random_state(generator, state)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Let the state run on from call to call within the block."""
        self._keep = True
        try:
            yield
        finally:
            self._keep = False


@contextmanager
def untouched(thing: Any) -> Iterator[None]:
    """Restore random generators, and the attributes of objects, after the block.

    Args:
        thing: a function or an object of the user.
    """
    state = State(thing)
    with state.restored_afterwards():
        state.prepare()
        yield


@contextmanager
def examples(thing: Any) -> Iterator[None]:
    """Let functions answer about examples, not about what an environment gave; see ``untouched``.

    Each function is looked at once.
    """
    with untouched(thing):
        mode = _mode.set("examples")
        try:
            yield
        finally:
            _mode.reset(mode)


def _put(attributes: Attributes, how: Callable[[Any], Any] = lambda value: value) -> None:
    for space, values in attributes:
        for name in space.keys() - values.keys():
            del space[name]
        space.update({name: how(value) for name, value in values.items()})


GENERATORS: dict[type, tuple[Callable[[Any], Any], Callable[[Any, Any], Any]]] = {
    random.Random: (lambda g: g.getstate(), lambda g, state: g.setstate(state)),
    np.random.Generator: (
        lambda g: g.bit_generator.state,
        lambda g, state: setattr(g.bit_generator, "state", state),
    ),
    np.random.RandomState: (lambda g: g.get_state(), lambda g, state: g.set_state(state)),
}
"""Kinds of random generators: how their state is read and set."""


def _global_generators() -> Iterator[Any]:
    """Yield the generators of Python, NumPy and torch; torch is not imported for that."""
    yield random.random.__self__  # type: ignore[attr-defined]
    yield np.random.get_state.__self__  # type: ignore[attr-defined]  # noqa: NPY002
    if (torch := sys.modules.get("torch")) is not None:
        yield torch.default_generator


def _random_state(generator: Any) -> Any:
    for kind, (read, _) in GENERATORS.items():
        if isinstance(generator, kind):
            return read(generator)
    return generator.get_state().numpy()


def _set_random_state(generator: Any, state: Any) -> None:
    for kind, (_, write) in GENERATORS.items():
        if isinstance(generator, kind):
            write(generator, state)
            return
    generator.set_state(sys.modules["torch"].from_numpy(state))


def _reachable(thing: Any, known: dict[int, Any], depth: int = DEPTH) -> Iterator[Any]:
    """Yield the attributes of the user's objects in a function or an object, dicts and generators.

    Args:
        known: the objects that were searched, by ``id``.
    """
    while isinstance(thing, partial):
        thing = thing.func
    if id(thing) in known:
        return
    known[id(thing)] = thing
    if isinstance(thing, types.MethodType):
        yield from _reachable(thing.__func__, known, depth)
        yield from _reachable(thing.__self__, known, depth)
        return
    kinds = type(thing).__mro__
    if (
        isinstance(thing, tuple(GENERATORS))
        or kinds[0].__module__ == "torch._C"
        and (kinds[0].__name__ == "Generator")
    ):
        yield thing
        return
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
    elif isinstance(thing, dict) and len(thing) < MOST_KEYS:
        space = thing
        yield space
    else:
        return
    for value in list(space.values()) if depth else ():
        yield from _reachable(value, known, depth - 1)


def _copied(value: Any) -> Any:
    """Return a copy of a value that may change in place; of others the value itself."""
    try:
        return copy.deepcopy(value) if isinstance(value, CHANGING) else value
    except Exception:  # it cannot be copied
        return value


def _equal(one: Any, other: Any) -> bool:
    """Return whether two values are equal but for rounding."""
    try:
        return bool(np.isclose(one, other, rtol=1e-4, atol=1e-6, equal_nan=True).all())
    except Exception:  # of texts, parts with names, and objects
        return repr(one) == repr(other)
