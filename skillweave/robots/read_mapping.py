"""What was read of a file about a policy: ``sees``, ``acts``, and the source of each number."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skillweave._internal.messages import aligned, short
from skillweave._internal.notebooks import joined, paragraph, table
from skillweave.skills.mapping import (
    Acts,
    Computed,
    Goal,
    LastAction,
    Part,
    Source,
    checked_sees,
    function_name,
)

SHOWN = ("scale", "offset", "clip", "history")
"""The settings with a column of their own."""
CHANGED = "changed after reading"
"""The source of a number that the user has set since."""


@dataclass(frozen=True)
class ReadTerm:
    """A term of a policy's input, or its action, as it was read.

    Attributes:
        name: the file's.
        entry: the entry of ``sees``, or ``Acts``.
        numbers: how many; None: unknown.
        sources: the field of the file, by setting.
    """

    name: str
    entry: Source | Acts
    numbers: int | None
    sources: dict[str, str] = field(default_factory=dict)


class ReadMapping(dict[str, Any]):
    """The arguments ``sees`` and ``acts`` of ``from_onnx``, read of a file; print it.

    It is changed as a dict is: ``read["acts"] = dataclasses.replace(read["acts"], rest=0.0)``.

    Args:
        file: the name of the file.
        terms: those of each input, by its name; "": the only one.
        action: the meaning of the outputs.
        gains: stiffness and damping.
        unsaid: what the file does not say.
    """

    def __init__(
        self,
        file: str,
        terms: Mapping[str, Sequence[ReadTerm]],
        action: ReadTerm,
        gains: Mapping[str, Any],
        unsaid: Sequence[str],
    ) -> None:
        sees: Any = {name: tuple(term.entry for term in read) for name, read in terms.items()}
        super().__init__(sees=sees[""] if set(sees) == {""} else sees, acts=action.entry)
        self.file = file
        self.gains = dict(gains)
        """``stiffness`` and ``damping``, (joints,) in the environment's order, to compare with the
        simulator's: gains are the environment's. NaN: the file has none."""
        self.unsaid = tuple(unsaid)
        """What the file does not say, so it was assumed, or is left to you."""
        self._terms = {name: tuple(read) for name, read in terms.items()}
        self._action = action

    def sources(self) -> dict[str, dict[str, str]]:
        """Return the field of the file from which each setting is, by term and setting."""
        found: dict[str, dict[str, str]] = {}
        for term in self._now():
            found.setdefault(term.name, {}).update(term.sources)
        return found

    def __str__(self) -> str:
        return "\n\n".join([aligned([list(_HEAD), *self._rows()], left=2), *self._notes()])

    def _repr_html_(self) -> str:
        return joined([table(_HEAD, self._rows(), left=2), *map(paragraph, self._notes())])

    def _rows(self) -> list[list[str]]:
        return [_row(term) for term in self._now()]

    def _notes(self) -> list[str]:
        """Return the sources of numbers, gains, and what was not said."""
        notes = ["Where numbers are from:"]
        for name, fields in self.sources().items():
            text = ", ".join(f"{setting} = {source}" for setting, source in fields.items())
            notes[0] += f"\n- {name}: {text or 'nothing but its name'}"
        gains = [f"{name} {_numbers(tuple(values))}" for name, values in self.gains.items()]
        notes.append(f"Gains, which are the environment's: {', '.join(gains) or 'not given'}")
        notes.append("\n- ".join(["Not said by the file:", *self.unsaid]))
        return notes

    def _now(self) -> Iterator[ReadTerm]:
        """Yield the terms as they are now, with the source of each number."""
        for name, parts in checked_sees(self["sees"]).items():
            read = self._terms.get(name, ())
            known = {id(term.entry): term for term in read}
            for i, part in enumerate(parts):
                before = known.get(id(part))
                if before is None and len(parts) == len(read):
                    before = read[i]
                yield _compared(before, part)
        if isinstance(self.get("acts"), Acts):
            yield _compared(self._action, self["acts"])


def _compared(before: ReadTerm | None, now: Any) -> ReadTerm:
    """Return a term as it is now; its sources are those that were read where nothing changed."""
    if before is None or type(before.entry) is not type(now):
        return ReadTerm("-" if before is None else before.name, now, None, {"all": CHANGED})
    if before.entry is now:
        return before
    changed = [
        k for k, x in vars(now).items() if x is not (y := getattr(before.entry, k)) and x != y
    ]
    sources = before.sources | dict.fromkeys(changed, CHANGED)
    numbers = None if {"key", "places", "to"} & set(changed) else before.numbers
    return ReadTerm(before.name, now, numbers, sources)


_HEAD = ("term", "from", "numbers", *SHOWN)


def _row(term: ReadTerm) -> list[str]:
    """Return a row of the table."""
    entry = term.entry
    numbers = "-" if term.numbers is None else str(term.numbers)
    return [term.name, _place(entry), numbers, *(_numbers(getattr(entry, k, None)) for k in SHOWN)]


def _place(entry: Source | Acts) -> str:
    """Return what an entry reads or writes."""
    if isinstance(entry, Part):
        return (entry.key or "observation") + _places(entry.places)
    if isinstance(entry, Acts):
        return f"to the action{_places(entry.to)}"
    if isinstance(entry, Goal | LastAction):
        return f"{type(entry).__name__}()"
    return function_name(entry.function) if isinstance(entry, Computed) else type(entry).__name__


def _places(places: Any) -> str:
    if places is None:
        return ""
    if isinstance(places, slice):
        return f"[{places.start or 0}:{'' if places.stop is None else places.stop}]"
    return short(list(places), 24)


def _numbers(value: Any) -> str:
    """Return a setting for the table: a number, or the range of several."""
    if value is None:
        return "-"
    if not isinstance(value, tuple):
        return f"{value:g}"
    with np.errstate(invalid="ignore"):
        low, high = np.nanmin(value), np.nanmax(value)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
