"""``--evolve`` settings as ``population=8``: a parser of its own, apart from training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from skillweave.api.running import apart_to_evolve
from skillweave.cli.overrides import replaced
from skillweave.errors import DeclarationError
from skillweave.evolution.config import Evolution, Range, Tournament, Truncation
from skillweave.hierarchy.declaration import Declaration

SELECTIONS: dict[str, Any] = {"tournament": Tournament, "truncation": Truncation}


def parse_evolve(
    settings: Sequence[str], declaration: Declaration, flat: bool
) -> dict[str, Evolution | None] | None:
    """Return each stage's evolution, or None where nothing is to evolve.

    A name may begin with a stage; settings without one hold for all. ``selection=truncation``
    takes that selection, ``ranges.gamma=0.9,0.999,complement`` lets a setting mutate.

    Raises:
        DeclarationError: no such setting (with close matches), or a value out of range.
    """
    if not settings:
        return None
    if flat:
        stages = declaration.plain_agent().stages()
    else:
        stages = apart_to_evolve(declaration)[0].stages()
    names = [p.name for p in stages]
    shared = list[tuple[str, str, str]]()
    by_stage = {name: list[tuple[str, str, str]]() for name in names}
    for setting in settings:
        name, sign, text = (part.strip() for part in setting.partition("="))
        if not sign:
            raise DeclarationError(f"--evolve {setting!r}: write name=value, such as population=8")
        head, _, rest = name.partition(".")
        if head in names and rest:
            by_stage[head].append((rest, name, text))
        else:
            shared.append((name, name, text))
    return {
        name: _evolution([*shared, *by_stage[name]]) if shared or by_stage[name] else None
        for name in names
    }


def _evolution(settings: list[tuple[str, str, str]]) -> Evolution:
    """Return an evolution from dotted names, names as they were written, and values."""
    ranges: dict[str, Range] = {}
    changes: dict[tuple[str, ...], tuple[str, str]] = {}
    start = Evolution()
    for name, written, text in settings:
        path = tuple(name.split("."))
        if path == ("selection",):
            if text.lower() not in SELECTIONS:
                known = ", ".join(SELECTIONS)
                raise DeclarationError(f"--evolve {written}={text}: expected one of {known}")
            start = replace(start, selection=SELECTIONS[text.lower()]())
        elif path[:-1] in (("ranges",), ("mutations", "ranges")):
            ranges[path[-1]] = _range(written, text)
        else:
            changes[path] = written, text
    evolution: Evolution = replaced(start, changes)
    if ranges:
        evolution = replace(evolution, mutations=replace(evolution.mutations, ranges=ranges))
    return evolution


def _range(written: str, text: str) -> Range:
    try:
        low, high, *scale = (part.strip() for part in text.split(","))
        return Range(float(low), float(high), *scale)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise DeclarationError(
            f"--evolve {written}={text}: write low,high or low,high,scale ({error})"
        ) from error
