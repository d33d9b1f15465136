"""A call of a user's function that is repeated for other rows, and answers compared by row."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from skillweave.policies.core import Array, read_only


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
    """Return arguments of a user's function with ``change`` of all values in them."""
    if is_dataclass(given):
        parts = {f.name: changed(getattr(given, f.name), change) for f in fields(given)}
        kind: Any = type(given)
        return kind(**parts)
    if type(given) is dict:  # an info that has columns for missing keys is more than a dict
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
    """Yield all values in arguments of a user's function, without those in infos."""
    if is_dataclass(given):
        for part in fields(given):
            if part.name != "info":
                yield from _values(getattr(given, part.name))
    elif isinstance(given, tuple | dict):
        for value in given.values() if isinstance(given, dict) else given:
            yield from _values(value)
    else:
        yield given


def as_type(x: Any, kind: str) -> Any:
    """Return whole numbers as int64 (``kind`` "wide"), or their bytes with the other sign."""
    if not isinstance(x, np.ndarray) or x.dtype == (to := _other_type(x.dtype, kind)):
        return x
    return read_only(x.astype(to) if kind == "wide" else np.ascontiguousarray(x).view(to))


def _other_type(dtype: np.dtype[Any], kind: str) -> np.dtype[Any]:
    """Return another type of whole numbers for rows with which a function is called again."""
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


def sizes_in(x: Array) -> Iterator[int]:
    """Yield sizes of later axes in a user's arguments, which other rows must not have."""
    yield from x.shape[1:]
    parts = [x.dtype]
    for dtype in parts:
        for part, *_ in (dtype.fields or {}).values():
            yield from part.shape
            parts.append(part.base)


def narrow_types(dtype: np.dtype[Any]) -> Iterator[str]:
    """Yield the types of whole numbers in a user's arguments that are not int64."""
    for part, *_ in (dtype.fields or {}).values():
        yield from narrow_types(part.base)
    if dtype.kind in "iu" and dtype != np.int64:
        yield str(dtype)


# Answers


def parts_of(answer: Any) -> dict[str, Array]:
    """Return the arrays in a user's answer, by name; {}: it is odd."""
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
    answer: Mapping[str, Array],
    other: Mapping[str, Array],
    rows: Array,
    close: float = 1e-3,
    of_largest: float = 1e-5,
) -> tuple[Any, Any, int] | None:
    """Return the answers that differ most, and their row; None: all are equal but for rounding.

    Args:
        rows: of the ``answer``, those of which ``other`` is.
        close: the part of a number up to which a difference is rounding.
        of_largest: and of the largest number.
    """
    for name, x in answer.items():
        one, two = x[rows].reshape(len(rows), -1), other[name].reshape(len(rows), -1)
        if one.dtype.kind == two.dtype.kind == "f" or {one.dtype.kind, two.dtype.kind} == {
            "f",
            "i",
        }:
            one, two = one.astype(np.float64), two.astype(np.float64)
            size = np.abs(one, where=np.isfinite(one), out=np.zeros(one.shape))
            least = 1e-6 + close * size + of_largest * size.max(initial=0.0)
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
    """Return rows in another number and order, for which statistics are other ones.

    They are rows with the same answer, if a quarter of all has it: where "above the mean" is true,
    it is false for the least of these rows alone. Else they are one row, again and again: none with
    the largest answer, which may be what the others are compared with.

    Args:
        taken: numbers of rows that would not show a wrong axis.
        look: the number of looks before; every second one takes other rows.
    """
    order = np.arange(n)
    equal = np.ones(n, bool)
    values = next(iter(answer.values())).reshape(n, -1)[:, 0]
    with suppress(TypeError):  # of objects
        order = np.argsort(values, kind="stable")
        equal = values[order] == values[np.roll(order, 1)]
    if look % 2:
        order = order[::-1]
        equal = np.roll(equal[::-1], 1)
    starts = np.flatnonzero(~equal)
    lengths = np.diff([*starts, n])
    group = order[look % n :][:1]  # all answers are equal
    if len(starts) and 4 * lengths.max() >= n:
        first = starts[lengths.argmax()]
        group = order[first : first + lengths.max()]
    elif len(starts):
        sizes = np.abs(values) if values.dtype.kind in "fiu" else values
        group = np.argsort(sizes, kind="stable")[n // (4 if look % 2 else 2) :][:1]
    group, size = group[::-1], min(len(group), most)
    numbers = itertools.chain(range(size, 2, -1), itertools.count(max(size, 3)))
    count = next(m for m in numbers if m not in taken)
    return group[np.arange(count) % len(group)]


def shown(value: Any) -> str:
    """Return a value of an answer for messages."""
    value = getattr(value, "item", lambda: value)()
    return f"{value:.4g}" if isinstance(value, float) else repr(value)
