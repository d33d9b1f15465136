"""Spaces of observations, actions and goals as data: numbers and choices, alone or in named parts.

They are Gymnasium's, without Gymnasium.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from .acting_errors import PolicyError, SkillError, SkillweaveError
from .core import Array
from .infos import NUMBERS
from .untrusted import shown

Kind = Literal["Box", "Discrete", "MultiDiscrete", "MultiBinary", "Dict", "Tuple"]
MOST = 10**8
"""The most numbers of one space: a damaged shape must not take all memory."""
DTYPE = re.compile("[<>=|]?(bool|u?int|float|longdouble|[biuf])[0-9]*")
"""NumPy's names of types of numbers."""
MOST_CHOICES, MOST_OF_ALL = 256, 10_000
"""The most values of a whole number of a Box, and of all its numbers, that are choices: each is an
output of a network."""


@dataclass(eq=False)
class Space:
    """A space as plain data, without Gymnasium: arrays (…, *shape) in bounds, or named parts.

    Raises:
        PolicyError: it is none.
    """

    kind: Kind
    """The name of Gymnasium's class."""
    dtype: str = ""
    """NumPy's name of the type of its numbers; "": it has parts."""
    shape: tuple[int, ...] = ()
    low: Array | None = None
    """(*shape) or one for all: the lowest numbers, or the first choices."""
    high: Array | None = None
    """(*shape) or one for all: the highest numbers, or the last choices."""
    parts: dict[str, Space] | None = None
    """The parts of a Dict or Tuple, in order; None: another space."""

    def __post_init__(self) -> None:
        if self.parts is not None or self.kind in ("Dict", "Tuple"):
            if not self.parts or self.kind not in ("Dict", "Tuple"):
                names = shown(list(self.parts or ()))
                raise PolicyError(f"a space is a {self.kind} of the parts {names}")
            if "" in self.parts:
                raise PolicyError(f"a {self.kind} has a part without a name")
            return
        if any(n < 0 for n in self.shape) or np.prod(self.shape, dtype=float) > MOST:
            raise PolicyError(
                f"a space has the shape {shown(self.shape)}, but at most {MOST:,} numbers"
            )
        try:
            if not DTYPE.fullmatch(self.dtype):
                raise TypeError
            kind = np.dtype(self.dtype).kind
            low, high = (np.broadcast_to(x, self.shape) for x in (self.low, self.high))  # type: ignore[arg-type]
            fits = kind in "biuf" and bool((low <= high).all())
            fits &= self.kind == "Box" or kind in "iu"
            fits &= self.kind != "Discrete" or self.shape == ()
        except (TypeError, ValueError):
            fits = False
        if not fits:
            raise PolicyError(
                f"{shown(vars(self), 200)} is no space: it needs a type of numbers, and bounds of "
                "its shape"
            )

    def __str__(self) -> str:
        if self.parts is not None:
            named = (f"{k!r}: " * (self.kind == "Dict") + str(x) for k, x in self.parts.items())
            return f"{self.kind}({', '.join(named)})"
        low, high = (np.asarray(x) for x in (self.low, self.high))
        if self.kind == "Box":
            return f"Box({low}, {high}, {self.shape}, {self.dtype})"
        if self.kind == "MultiBinary":
            return f"MultiBinary({self.shape[0] if len(self.shape) == 1 else self.shape})"
        return f"{self.kind}({high - low + 1}{f', start={low}' if low.any() else ''})"

    @cached_property
    def record(self) -> np.dtype[Any]:
        """The type of one element; of parts aligned, so that each can be read without a copy."""
        if self.parts is None:
            return np.dtype(self.dtype)
        fields = [(name, part.record, part.shape) for name, part in self.parts.items()]
        return np.dtype(fields, align=True)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """The lowest and the highest numbers; of real ones in their own type."""
        ends = tuple(np.asarray(x) for x in (self.low, self.high))
        if np.dtype(self.dtype).kind == "f":
            with np.errstate(over="ignore"):  # an infinity
                ends = tuple(x.astype(self.dtype) for x in ends)
        low, high = ends
        return low, high

    @cached_property
    def size(self) -> int:
        """The number of numbers of one element, as ``flat`` has them."""
        return sum(math.prod(leaf.shape) for leaf in self.leaves.values())

    @cached_property
    def counts(self) -> list[int]:
        """The number of options of each choice."""
        if self.parts is not None:
            return [n for part in self.parts.values() for n in part.counts]
        if np.dtype(self.dtype).kind == "f":
            return []
        if self.kind == "Box" and math.prod(self.shape) > MOST_OF_ALL:
            return []
        low, high = (np.asarray(x).astype(object) for x in self.bounds)
        counts: list[int] = np.broadcast_to(high - low + 1, self.shape).reshape(-1).tolist()
        many = max(counts, default=0) > MOST_CHOICES or sum(counts) > MOST_OF_ALL
        return [] if self.kind == "Box" and many else counts

    @cached_property
    def leaves(self) -> dict[tuple[str, ...], Space]:
        """The innermost parts, in order, by the names that lead to them."""
        if self.parts is None:
            return {(): self}
        return {
            (name, *path): leaf
            for name, part in self.parts.items()
            for path, leaf in part.leaves.items()
        }

    def is_like(self, other: Space) -> bool:
        """Return whether elements of both have the same form, and the same choices."""
        return (self.record, self.shape, self.counts) == (other.record, other.shape, other.counts)

    def start(self, n: int) -> Array:
        """Return n elements (n, …): zeros, or as near as a Box allows, and first choices."""
        found = np.zeros((n, *self.shape), self.record)
        for path, leaf in self.leaves.items():
            low, high = leaf.bounds
            zero = np.zeros(leaf.shape, leaf.record)
            at(found, path)[...] = zero.clip(low, high) if leaf.kind == "Box" else low
        return found

    def holds(self, x: Array) -> Array:
        """Return which rows of x (n, …) are elements, (n,) bool."""
        found = np.ones(len(x), bool)
        for path, leaf in self.leaves.items():
            part = at(x, path)
            low, high = leaf.bounds
            inside = (part >= low) & (part <= high)  # False for NaN
            if part.dtype.kind == "f":
                inside &= np.isfinite(part)
            found &= inside.reshape(len(x), -1).all(axis=1)
        return found

    def by_name(self, value: Any) -> dict[str, Any] | None:
        """Return the parts of a value of a Dict or Tuple by name; None: it has none.

        Those of a tuple or list have their places as names, those of a structured array its fields.
        """
        if self.kind == "Tuple" and isinstance(value, tuple | list):
            return {str(place): part for place, part in enumerate(value)}
        names = getattr(getattr(value, "dtype", None), "names", None)
        if isinstance(value, Mapping) or names:
            return {str(name): value[name] for name in names or value}
        return None

    def packed(self, value: Any, where: str = "obs") -> Array:
        """Return a value of the environment, or of a function, as one array (*shape).

        Args:
            value: of a Dict or Tuple dicts and tuples, or an array of its parts.
            where: begins messages.

        Raises:
            PolicyError: it does not fit.
        """
        if self.parts is None:
            if (
                type(value) is np.ndarray
                and value.dtype == self.record
                and value.shape == self.shape
            ):
                return value
            try:
                found = np.asarray(value)
                # A row of a table, for example; None would become a NaN.
                if found.dtype.kind in "OU" and None not in found.reshape(-1).tolist():
                    found = found.astype(self.dtype)
            except (TypeError, ValueError) as error:
                raise PolicyError(f"{where} is not numbers: {error}") from error
            if found.dtype.kind not in "biuf":
                raise PolicyError(f"{where} is {found.dtype}, not numbers: {self}")
            if found.shape != self.shape:
                one = "; give one, without an axis of environments"
                raise PolicyError(
                    f"{where} has shape {found.shape}, not {self.shape}"
                    + one * (found.shape[1:] == self.shape)
                )
            with np.errstate(invalid="ignore"):  # a NaN is no whole number, which is said below
                numbers = found.astype(self.dtype, copy=False)
            if self.record.kind != "f" and (changed := numbers != found).any():
                raise PolicyError(
                    f"{where} has the number {found[changed][0]}, which {self.dtype} of {self} "
                    "cannot hold"
                )
            return numbers
        if isinstance(value, np.ndarray) and value.dtype == self.record:
            return value
        named = type(value) is dict and value.keys() >= self.parts.keys()
        given = value if named else self.by_name(value)
        names = list(self.parts)
        if given is None or (self.kind == "Tuple" and len(given) > len(names)):
            shape = getattr(value, "shape", None)
            has = type(value).__name__ if shape is None else f"an array of shape {shape}"
            raise PolicyError(f"{where} is {has}, not a {self.kind} of {names}")
        out = np.zeros((), self.record)
        for name, part in self.parts.items():
            if name not in given:
                raise PolicyError(f"{where} has no part {name!r}; {self.kind} of {names}")
            out[name] = part.packed(given[name], f"{where}[{name!r}]")
        return out

    def unpacked(self, x: Any) -> Any:
        """Return one element as the environment takes it: dicts and tuples of ints and arrays."""
        if self.parts is None:
            # A part without axes is a NumPy scalar, which a Box does not contain.
            return int(x) if self.kind == "Discrete" else np.asarray(x)
        inner = {name: part.unpacked(x[name]) for name, part in self.parts.items()}
        return tuple(inner.values()) if self.kind == "Tuple" else inner

    def allowed(self, value: Any, what: str = "its action_mask") -> Array:
        """Return a mask of an environment or a user for the choices of actions as (A,) bool.

        Several choices may have a list each. The mask of a Dict or Tuple is a dict or tuple of
        masks, and where a part has none, all is allowed. It may also be one array.

        Raises:
            ValueError: it does not have a number for each choice; ``what`` begins the message.
        """
        names = self.parts or {}
        given = self.by_name(value) if names else None
        if isinstance(value, tuple | list) and all(isinstance(x, NUMBERS) for x in value):
            given = None  # one list for all parts
        if given is not None:
            lacks = self.kind == "Tuple" and len(given) < len(names)
            if lacks or not set(given) <= set(names):
                raise ValueError(
                    f"{what} has the parts {shown(list(given))}, but actions of {str(self)[:200]} "
                    f"have {', '.join(map(repr, names))}"
                )
            masks = [
                part.allowed(given[name], f"{what}[{name!r}]")
                if given.get(name) is not None and part.counts
                else np.ones(sum(part.counts), bool)
                for name, part in names.items()
            ]
            return np.concatenate(masks)
        mask = _numbers(value)
        size = sum(self.counts)
        if mask.size != size or mask.dtype.kind not in "iubf":
            raise ValueError(
                f"{what} is {shown(value, 200)}; it must be a number for each choice of {self}, "
                f"{size} in all, 0 where it is forbidden"
            )
        return np.asarray(mask.reshape(-1) != 0)

    def actions(
        self, value: Any, n: int, who: str, kind: type[SkillweaveError] = PolicyError
    ) -> Array:
        """Return n actions that a policy gave, (n, …): numbers are clipped, choices must exist.

        Raises:
            PolicyError: it gave something else; ``who`` begins the message, ``kind`` is its type.
        """
        given = self._given(value, n, who, kind)
        if self.parts is not None:
            found = np.zeros(n, self.record)
            for name, part in self.parts.items():
                found[name] = part.actions(given[name], n, f"{who}: part {name!r}", kind)
            return found
        x: Array = given
        low, high = self.bounds
        if self.kind == "Box":
            if not np.isfinite(x).all():
                raise kind(f"{who} returned a NaN or an infinity as an action of {self}")
            return x.clip(low, high).astype(self.record, copy=False)
        if (outside := (x < low) | (x > high)).any():
            raise kind(f"{who} returned {x[outside][0]}, which is no action of {self}")
        return x.astype(self.record, copy=False)

    def goals(
        self,
        values: Any,
        n: int,
        who: str,
        skill: str,
        rows: Array | None = None,
    ) -> Array:
        """Return goals as an array of the space's type, (n, *shape); no number changes.

        Whether they are in the space is not checked beyond that.

        Args:
            values: (n, *shape); of a Dict or Tuple also dicts and tuples of such arrays.
            who: whose goals they are, for messages.
            skill: the skill that gets them, for messages.
            rows: the environments (k,) whose goals are returned, (k, *shape); None: all. The goals
                of the others may be anything.

        Raises:
            SkillError: they have another shape or type, or a number that the type cannot hold.
        """
        known = getattr(values, "dtype", None), getattr(values, "shape", None)
        if known == (self.record, (n, *self.shape)):
            return np.asarray(values if rows is None else values[rows])
        given = self._given(values, n, who, SkillError, skill)
        if self.parts is not None:
            packed = np.zeros(n if rows is None else len(rows), self.record)
            for name, part in self.parts.items():
                whose = f"the part {name!r} of {skill}"
                packed[name] = part.goals(given[name], n, who, whose, rows)
            return packed
        goals: Array = given if rows is None else given[rows]
        with np.errstate(over="ignore"):  # an infinity is out of every space
            numbers = goals.astype(self.record)
        if self.record.kind != "f" and (changed := numbers != goals).any():
            row = np.argwhere(changed)[0, 0]
            raise SkillError(self.is_out(goals[row], who, skill) + "; give one in it")
        return numbers

    def _given(
        self, value: Any, n: int, who: str, kind: type[SkillweaveError], skill: str = ""
    ) -> Any:
        """Return n actions, or goals of a skill, as numbers (n, *shape), or their parts by name.

        Raises:
            PolicyError: they have another form; ``who`` begins the message, ``kind`` is its type.
        """
        noun = "action"
        gave = f"{who} returned"
        to = ""
        if skill:
            noun = "goal"
            gave = f"{who} gave goals of"
            to = f" for {skill}"
        shape = (n, *self.shape)
        each = "one environment" if n == 1 else f"each of the {n} environments"
        if value is None:
            raise kind(
                f"{who} returned None, but {noun}s {shape} were expected: is a return missing?"
            )
        if self.parts is not None:
            given = self.by_name(value)
            if given is not None and set(given) == set(self.parts):
                return given
            wanted = f"a dict with {', '.join(map(repr, self.parts))}"
            if self.kind == "Tuple":
                wanted = f"a tuple of {len(self.parts)} parts"
            has = f"{value!r:.100}" if given is None else f"the parts {list(given)!r:.100}"
            raise kind(
                f"{gave} {has}{to}, but {wanted} was expected: its {noun}s are of "
                f"{str(self)[:300]}, a row of each part for {each}"
            )
        try:
            x = np.asarray(value)
        except Exception as error:  # parts of unequal lengths, a tensor with a gradient
            raise kind(
                f"{gave} {value!r:.100}{to}, which are no {noun}s of {self}: the shape {shape} was "
                f"expected ({error})"
            ) from error
        if x.shape != shape:
            raise kind(
                f"{gave} shape {x.shape}{to}, but {shape} was expected: one {noun} of {self} for "
                f"{each}"
            )
        whole = self.record.kind != "f"
        if x.dtype.kind not in ("biu" if whole else "biuf"):
            rounds = not skill and whole and self.kind == "Box" and x.dtype.kind == "f"
            raise kind(
                f"{gave} {x.dtype}{to}, but {noun}s of {self} are {'whole ' * whole}numbers"
                + ": round them in a function, numpy.rint(actions).astype(int)" * rounds
            )
        return x

    def is_out(self, goal: Array, who: str, skill: str) -> str:
        """Return the message about a goal that is not in the space."""
        return (
            f"{who} gave the goal {goal.tolist()!r:.100}, which is out of goal_space {self} of "
            f"{skill}"
        )

    def choices_in(self, x: Array) -> Array:
        """Return the option of each choice in elements (n, …), counted from 0: (n, C) int64."""
        found = [np.zeros((len(x), 0), np.int64)]
        for path, leaf in self.leaves.items():
            if leaf.counts:
                found.append((at(x, path) - leaf.bounds[0]).reshape(len(x), -1))
        return np.concatenate(found, axis=1, dtype=np.int64)

    def flat(self, x: Array) -> Array:
        """Return elements (n, …) as numbers (n, G) float64, one part after another."""
        found = [
            at(x, path).reshape(len(x), math.prod(leaf.shape)).astype(np.float64)
            for path, leaf in self.leaves.items()
        ]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def of_numbers(self, numbers: Array) -> Array:
        """Return the elements (n, …) of numbers (n, G), as ``flat`` has them."""
        found = self.start(len(numbers))
        first = 0
        for path, leaf in self.leaves.items():
            part = at(found, path)
            size = math.prod(leaf.shape)
            part[...] = numbers[:, first : first + size].reshape(part.shape)
            first += size
        return found


def allows_each(mask: Array, counts: Sequence[int]) -> Array:
    """Return where a mask (…, A) allows an option of each choice, (…) bool.

    Args:
        counts: the number of options of each choice, as of ``Space.counts``.
    """
    starts = np.cumsum((0, *counts[:-1]))
    return np.asarray(np.logical_or.reduceat(mask, starts, axis=-1).all(axis=-1))


def at(x: Array, path: tuple[str, ...]) -> Array:
    """Return the part of records (…) with these names."""
    for name in path:
        x = x[name]
    return x


def _numbers(value: Any) -> Array:
    """Return a mask of actions as an array; of unequal lists their numbers, one after another."""
    try:
        mask = np.asarray(value)
    except ValueError:
        mask = np.array(None)
    if mask.dtype == object:
        with suppress(TypeError, ValueError):
            mask = np.concatenate([np.ravel(part) for part in value])
    return mask


def discrete(n: int) -> Space:
    """Return the space of the numbers below ``n``."""
    return Space("Discrete", "int64", (), np.asarray(0), np.asarray(n - 1))


def space_of(space: Any) -> Space:
    """Return a space of Gymnasium's as data, by its class's name: Gymnasium is not imported."""
    known = get_args(Kind)
    kind: Any = next(c.__name__ for c in type(space).__mro__ if c.__name__ in known)
    if kind in ("Dict", "Tuple"):
        inner = space.spaces.items() if kind == "Dict" else enumerate(space.spaces)
        return Space(kind, parts={str(name): space_of(part) for name, part in inner})
    shape = tuple(space.shape or ())
    dtype = str(np.dtype(space.dtype))
    if kind == "Box":
        return Space(kind, dtype, shape, _one(space.low), _one(space.high))
    start = np.asarray(getattr(space, "start", 0))
    count = 2 if kind == "MultiBinary" else getattr(space, "nvec", getattr(space, "n", None))
    return Space(kind, dtype, shape, start, np.asarray(start + count - 1))


def _one(bounds: Array) -> Array:
    """Return equal bounds as one number."""
    return bounds.reshape(-1)[0] if bounds.size and (bounds == bounds.flat[0]).all() else bounds
