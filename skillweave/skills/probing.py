"""Looks at users' functions: an answer about an environment must depend on that one alone.

At some of its calls a function is called twice more: with other rows, and with the same rows
again, whose whole numbers are widened to int64. A difference has one of these causes:

- A result of the right shape by chance: ``step.next_obs[0]`` has four numbers for four environments
  of CartPole.
- Statistics over the environments: ``obs - obs.mean(0)``.
- A state that the function keeps, or random numbers.
- Bytes that wrap around: 3 - 4 is 255.

Further calls, which find the cause, are made only after a difference. Each look leaves the random
generators, and the attributes of the user's objects, as they were.
"""

from __future__ import annotations

import inspect
import types
import weakref
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from skillweave._internal.messages import error_text
from skillweave._internal.notices import notice
from skillweave._internal.tracebacks import is_own_code
from skillweave.errors import SkillError, SkillweaveError
from skillweave.policies.core import Array, read_only
from skillweave.skills.function_state import MODE, FunctionState
from skillweave.skills.rows import (
    Call,
    as_type,
    largest_difference,
    narrow_types,
    other_rows,
    parts_of,
    shown,
    sizes_in,
)

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


def _notes_of(owner: Any) -> dict[Any, Any] | None:
    """Return the notes about looks at a user's object; None: it can have none."""
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
    """Return the object and the name under which the notes about a function are kept."""
    while isinstance(function, partial):
        function = function.func
    return getattr(function, "__self__", function), getattr(function, "__name__", "")


def look_at(call: Call, judges: bool | None) -> Look | None:
    """Return a look at a function, before it is called; None: none is due.

    Args:
        judges: its answer to the same must never change; None: it may keep a state.
    """
    mode = MODE.get()
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
    if count not in LOOKS or repeated or (name, "said") in notes:
        return None
    return Look(call, judges, LOOKS[count], wide=mode == "usual")


# Looks -----------------------------------------------------------------------------------------


class Look:
    """A comparison of a function's answer with its answers for other rows and wider numbers.

    It is made before the function is called, because it keeps the state of that moment.

    Args:
        judges: see ``look_at``.
        before: the number of looks before.
        wide: whole numbers are widened: the rows are an environment's, not examples.
    """

    def __init__(self, call: Call, judges: bool | None, before: int, *, wide: bool) -> None:
        self._call = call
        self._judges = judges
        self._before = before
        self._wide = wide
        self._state = FunctionState(call.owner or call.function, call.fixed)

    def check(self, answer: Any, who: str, kind: type[SkillweaveError]) -> None:
        """Compare the answer that the function has just given.

        Args:
            who: its name in messages.
            kind: the type of an error.

        Raises:
            SkillError: its answer does not depend on one environment alone.
        """
        call = self._call
        n = self._call.n
        parts = parts_of(answer)
        if not parts or any(x.shape[:1] != (n,) or not x.size for x in parts.values()):
            return  # the caller says so
        self._n = n
        self._parts = parts
        self._who = who
        self._kind = kind
        size = sum(x.nbytes for x in call.arrays) // n
        self._most = int(np.clip(MOST_BYTES // max(size, 1), 8, 4096))
        state = self._state
        with state.restored_afterwards(), np.errstate(all="ignore"):
            self._written, self._random = state.written(), state.random()
            self._ask_others()

    def _ask_others(self) -> None:
        """Call the user's function again with other rows; compare its answers by row."""
        call = self._call
        every = np.arange(self._n)
        axes = {self._n, *(size for x in call.arrays for size in sizes_in(x))}
        rows = other_rows(self._parts, self._n, axes, self._most, self._before)
        other = self._checked_shape(rows)
        if self._judges is None:
            return
        few = every[: self._most]
        states = False
        narrow = sorted({t for x in call.arrays for t in narrow_types(x.dtype)})
        narrow = narrow if self._wide else []
        differs = self._difference(few, "wide" if narrow else "")
        if differs and (narrow or len(few) < self._n):
            wide = differs
            differs = self._difference(every)
            if narrow and not differs and not self._difference(few):
                self._notice_wrap(wide, narrow[0])
        if differs:
            self._refuse_state(differs)
            states = not self._difference(few, alone=True)
        elif self._written and not self._before:
            states = self._answers_by_state()
        if differs or states:
            self._look_no_more()
        if states and self._written:
            notice(f"{self._who} {self._fault}")
        elif other and not differs and not self._random:
            self._refuse_statistics(largest_difference(self._parts, other, rows))

    def _look_no_more(self) -> None:
        """Let this look be the last one: all is said, or answers cannot be compared."""
        owner, name = _owner_and_name(self._call.owner or self._call.function)
        notes = _notes_of(owner)
        assert notes is not None
        notes[name, "said"] = True

    def _checked_shape(self, rows: Array) -> dict[str, Array] | None:
        """Return the answer for other rows; None: nothing follows from it.

        Raises:
            SkillError: it failed, or has no row for each of them.
        """
        n = self._n
        m = len(rows)
        certain = []

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
            kind: see ``as_type``; "": no change.
            factor: of real numbers; other numbers become 0 unless it is 1.
            alone: the state is that of before the call; else it is that of now.
        """
        take = self._call.rows(rows)

        def change(x: Any) -> Any:
            x = take(x)
            if factor != 1.0 and isinstance(x, np.ndarray):
                x = read_only(x * np.float32(factor) if x.dtype.kind == "f" else np.zeros_like(x))
            return as_type(x, kind) if kind else x

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
        """Raise a SkillError where a user's function answers otherwise when called again."""
        if self._judges:
            before, after, _ = differs
            raise SkillError(
                f"{self._who} answers {before:g}, and {after:g} when it is asked about the "
                "same again, so it keeps a state of its own. Steps are judged in any order and "
                f"number, and later than they were made: {REMEMBER}"
            )

    def _refuse_statistics(self, differs: tuple[Any, Any, int] | None) -> None:
        """Raise an error where a user's function lets one environment depend on others."""
        if differs is not None:
            one, two, row = differs
            raise self._kind(
                f"{self._who} answers {shown(one)} for environment {row}, but {shown(two)} for the "
                "same one beside other environments, so its answer depends on the others: let it "
                "use the numbers of one environment alone, without statistics over the first axis "
                "(mean, max, median, a sum, the order)"
            )

    def _notice_wrap(self, differs: tuple[Any, Any, int], narrow: str) -> None:
        """Give a notice where a user's function computes in small integers that overflow."""
        if self._reads_bytes():
            return
        one, two, _ = differs
        self._look_no_more()
        notice(
            f"{self._who} answers {shown(one)}, but {shown(two)} for the same numbers as int64: a "
            f"result does not fit into {narrow}, and wraps around. Convert the numbers before you "
            "compute with them: obs.astype(np.float32)"
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


def reads_bytes(function: Any, depth: int = 2) -> bool:
    """Return whether a function, or one that it calls, reads the bytes or the type of numbers."""
    while isinstance(function, partial):
        function = function.func
    function = getattr(function, "__func__", function)
    if not isinstance(function, types.FunctionType):
        function = vars(type(function)).get("__call__")
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
