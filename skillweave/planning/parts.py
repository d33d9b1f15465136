"""Parts of missions, and the machine that they compile to."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any

from skillweave.errors import DeclarationError
from skillweave.planning.machine import MOST_STATES, Arrow
from skillweave.planning.predicates import Event, Held, Predicate

DONE = "done"
FAILED = "failed"
MOST_TOGETHER = 6
"""The most parts of one choice, or of one group in any order."""
MOST_ARROWS = 100_000
"""The most transitions of a mission."""


@dataclass(frozen=True)
class InOrder:
    """Parts that must be done one after another."""

    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Choice:
    """Parts of which one must be done."""

    parts: tuple[Part, ...]


@dataclass(frozen=True)
class AnyOrder:
    """Parts that must all be done, in any order."""

    parts: tuple[Part, ...]


Part = Event | InOrder | Choice | AnyOrder


def sequence(parts: Sequence[Part]) -> Part:
    """Return parts one after another; sequences among them are joined.

    Raises:
        DeclarationError: they are too many.
    """
    flat: list[Part] = []
    for part in parts:
        flat += _in_order(part)
        _check_size(len(flat))
    return flat[0] if len(flat) == 1 else InOrder(tuple(flat))


@dataclass(frozen=True)
class _Fragment:
    """A machine in the making: state 0 is its start, the last one its end.

    Args:
        arrows: the arrows that leave each state but the last.
        worth: of each state, from 0 to 1 at the end: the share that has been done.
        waits: the events in words that each state waits for.
        slots: counters side by side.
    """

    arrows: tuple[tuple[Arrow, ...], ...]
    worth: tuple[float, ...]
    waits: tuple[str, ...]
    slots: int

    @property
    def end(self) -> int:
        return len(self.arrows)


def compile_mission(
    legs: Part, avoid: Sequence[Predicate], repeat: int | None
) -> tuple[tuple[str, ...], list[Arrow], set[int], set[int]]:
    """Return the machine of a mission: its states, arrows, accepting and failing states."""
    parts, again = _in_order(sequence([legs] * (repeat or 1))), repeat is None
    _check_successions(parts, again)
    fragment = _fragment(InOrder(parts))
    ends = [DONE] * (not again) + [FAILED] * bool(avoid)
    names = (*_unique(fragment.waits), *ends)
    end, failed = fragment.end, len(names) - 1
    arrows: list[Arrow] = []
    for state, leaving in enumerate(fragment.arrows):
        arrows += [Arrow(state, failed, (bad,)) for bad in avoid]
        for arrow in leaving:
            reward = fragment.worth[arrow.target] - fragment.worth[state]
            # The end of a mission that repeats is the start of the next round.
            target = 0 if again and arrow.target == end else arrow.target
            arrows.append(replace(arrow, target=target, reward=reward))
    return names, arrows, set() if again else {end}, {failed} if avoid else set()


def _in_order(part: Part) -> tuple[Part, ...]:
    return part.parts if isinstance(part, InOrder) else (part,)


def _unique(waits: Sequence[str]) -> tuple[str, ...]:
    """Return names of states: what each waits for, with a number where two wait for the same."""
    names, number = dict.fromkeys((DONE, FAILED)), dict.fromkeys(waits, 1)
    for wait in waits:
        name = wait
        while name in names:
            number[wait] += 1
            name = f"{wait} #{number[wait]}"
        names[name] = None
    return tuple(names)[2:]


def _fragment(part: Part) -> _Fragment:
    if isinstance(part, InOrder):
        # A part that is repeated is one object, and has one fragment.
        fragments = {id(p): _fragment(p) for p in {id(p): p for p in part.parts}.values()}
        return _in_sequence([fragments[id(p)] for p in part.parts])
    if isinstance(part, Choice | AnyOrder):
        return _together([_fragment(p) for p in part.parts], isinstance(part, Choice))
    arrow = Arrow(0, 1, (part,))
    return _Fragment(((arrow,),), (0.0, 1.0), (part.name,), int(isinstance(part, Held)))


def _in_sequence(parts: Sequence[_Fragment]) -> _Fragment:
    """Join the end of each fragment to the start of the next; all use the same counters."""
    _check_size(sum(p.end for p in parts), sum(len(a) for p in parts for a in p.arrows))
    arrows: list[tuple[Arrow, ...]] = []
    worth: list[float] = []
    for i, part in enumerate(parts):
        first = len(arrows)
        for leaving in part.arrows:
            arrows.append(
                tuple(
                    replace(
                        a,
                        origin=a.origin + first,
                        target=a.target + first,
                        # Counters that the next part uses start again.
                        keeps=frozenset() if a.target == part.end else a.keeps,
                    )
                    for a in leaving
                )
            )
        worth += [(i + w) / len(parts) for w in part.worth[:-1]]
    waits = tuple(w for part in parts for w in part.waits)
    return _Fragment(tuple(arrows), (*worth, 1.0), waits, max(p.slots for p in parts))


def _together(parts: Sequence[_Fragment], first_ends: bool) -> _Fragment:
    """Run fragments side by side, each with counters of its own, until one or all have ended."""
    offsets = [0, *itertools.accumulate(p.slots for p in parts)]
    start = (0,) * len(parts)
    numbers, queue, leaving = {start: 0}, [start], list[list[tuple[tuple[int, ...], Arrow]]]()
    count, is_over = 0, any if first_ends else all
    for places in queue:  # it grows
        count += prod(
            1 + len(p.arrows[at]) if at < p.end else 1 for at, p in zip(places, parts, strict=True)
        )
        _check_size(len(queue), count)
        leaving.append(list(_joint_arrows(places, parts, offsets)))
        for target, _ in leaving[-1]:
            over = is_over(at == p.end for at, p in zip(target, parts, strict=True))
            if not over and target not in numbers:
                numbers[target] = len(queue)
                queue.append(target)
    end = len(queue)
    arrows = tuple(
        tuple(replace(a, origin=i, target=numbers.get(target, end)) for target, a in some)
        for i, some in enumerate(leaving)
    )
    shares = [[p.worth[at] for at, p in zip(places, parts, strict=True)] for places in queue]
    worth = [max(s) if first_ends else sum(s) / len(s) for s in shares]
    word = " or " if first_ends else " and "
    waits = tuple(
        word.join(p.waits[at] for at, p in zip(places, parts, strict=True) if at < p.end)
        for places in queue
    )
    return _Fragment(arrows, (*worth, 1.0), waits, offsets[-1])


def _joint_arrows(
    places: tuple[int, ...], parts: Sequence[_Fragment], offsets: Sequence[int]
) -> Any:
    """Yield (target, arrow) from a state of fragments side by side.

    Several fragments may go on in the same step, so arrows of more fragments come first.
    """
    choices: list[list[Arrow | None]] = []
    for at, part in zip(places, parts, strict=True):
        choices.append([*(part.arrows[at] if at < part.end else ()), None])
    combined = [c for c in itertools.product(*choices) if any(a is not None for a in c)]
    combined.sort(key=lambda c: -sum(a is not None for a in c))
    for arrows in combined:
        events, keeps, target = [], set[int](), []
        for i, (arrow, part) in enumerate(zip(arrows, parts, strict=True)):
            own = range(offsets[i], offsets[i] + part.slots)
            if arrow is None:
                keeps.update(own)
                target.append(places[i])
                continue
            events += [
                replace(e, slot=e.slot + offsets[i]) if isinstance(e, Held) else e
                for e in arrow.events
            ]
            keeps.update(slot + offsets[i] for slot in arrow.keeps)
            target.append(arrow.target)
        yield tuple(target), Arrow(0, 0, tuple(events), 0.0, frozenset(keeps))


def _check_size(states: int, arrows: int = 0) -> None:
    """Raise a DeclarationError where a mission would be too large, before it is built."""
    for count, most, what in (
        (states, MOST_STATES, "states"), (arrows, MOST_ARROWS, "transitions"),
    ):  # fmt: skip
        if count > most:
            raise DeclarationError(
                f"the mission has more than {most:,} {what}: repeat it less often, or combine "
                "fewer parts by 'and' or 'or'"
            )


def _check_successions(parts: Sequence[Any], again: bool) -> None:
    """Raise a DeclarationError where one visit would do two legs at once."""
    for a, b in itertools.pairwise([*parts, parts[0]] if again else parts):
        if _is_one_visit(a, b):
            raise DeclarationError(
                f"the mission has {a.name!r} twice in a row, and one visit would do both; put a "
                f"leg between them, ~{a.name} for example ('not {a.name}' in a text)"
            )
    for part in parts:
        if isinstance(part, Choice | AnyOrder):
            for inner in part.parts:
                _check_successions(_in_order(inner), again=False)


def _is_one_visit(a: Part, b: Part) -> bool:
    """Return whether one step would do both parts: the same predicate of observations.

    A predicate of a step may mean a change, which does not happen twice.
    """
    if not isinstance(a, Predicate) or not isinstance(b, Predicate):
        return False
    return a.reads == b.reads == "obs" and a.function == b.function
