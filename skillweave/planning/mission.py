"""Missions (sequences, choices and repetitions of events), also as text; every task in one form."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any, NamedTuple, NoReturn

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short, suggest
from skillweave.calls.predicates import (
    LONGEST_HOLD,
    Event,
    Held,
    Predicate,
    as_event,
    as_predicate,
    named_predicates,
    predicate_of,
)
from skillweave.errors import DeclarationError
from skillweave.planning.goal import GoalTask
from skillweave.planning.machine import MOST_STATES, Arrow, RewardMachine
from skillweave.schema import AtLeastOne, fitted

DONE = "done"
FAILED = "failed"
MOST_TOGETHER = 6
"""The most parts of one choice, or of one group in any order."""
MOST_ARROWS = 100_000
"""The most transitions of a mission."""


@dataclass(frozen=True)
class InOrder:
    """Parts of a mission that must be done one after another."""

    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Choice:
    """Parts of a mission of which one must be done."""

    parts: tuple[Part, ...]


@dataclass(frozen=True)
class AnyOrder:
    """Parts of a mission that must all be done, in any order."""

    parts: tuple[Part, ...]


Part = Event | InOrder | Choice | AnyOrder


def sequence(parts: Sequence[Part]) -> Part:
    """Return parts of a mission one after another; sequences among them are joined.

    Raises:
        DeclarationError: they are too many.
    """
    flat: list[Part] = []
    for part in parts:
        flat += _in_order(part)
        _check_size(len(flat))
    return flat[0] if len(flat) == 1 else InOrder(tuple(flat))


@checked_names
class Mission(RewardMachine):
    """A task whose legs are done in their order; each leg pays its share of 1.

    ```python
    from skillweave.planning import Mission, either, held


    def left(obs):
        return obs[:, 0] < -0.5


    def right(obs):
        return obs[:, 0] > 0.5


    def in_box(obs):
        return abs(obs[:, 1] - 0.6) < 0.2


    def crashed(step):
        return step.terminated


    task = Mission(left, either(right, held(in_box, 100)), avoid=crashed)
    same = Mission.from_text(
        "left then (right or in_box for 100 steps), avoid crashed",
        {"left": left, "right": right, "in_box": in_box, "crashed": crashed},
    )
    ```

    A leg is done in the first step in which its event holds, once the legs before it are done. The
    parts of a sequence share what the sequence is worth equally. A choice pays what its furthest
    part has earned; parts in any order pay as each is done.

    Args:
        legs: predicates, functions of observations or of a ``Step``, ``held(...)``,
            ``either(...)``, ``in_any_order(...)``, other missions, or lists of these (sequences).
        avoid: predicates; where one holds before the mission is done, it has failed.
        repeat: the number of times that the legs are done; None: again and again, without an end.

    Raises:
        DeclarationError: it has no legs, a leg has a wrong type, or two legs in succession are the
            same predicate of observations, so that one visit would do both.
    """

    def __init__(self, *legs: Any, avoid: Any = (), repeat: int | None = 1) -> None:
        if not legs:
            raise DeclarationError("a Mission has no legs; give at least one: Mission(left, right)")
        self.legs = _part(list(legs), "Mission")
        avoid = [avoid] if callable(avoid) or not isinstance(avoid, Collection) else list(avoid)
        self.avoid = tuple(as_predicate(a, "Mission: avoid") for a in avoid)
        functions = [predicate.function for predicate in self.avoid]
        if both := [x.name for x in _needed(self.legs) if x.function in functions]:
            raise DeclarationError(
                f"Mission: {both[0]!r} must be done and must be avoided: leave out one of them"
            )
        self.repeat = fitted(AtLeastOne | None, repeat, "Mission: repeat")
        self._build(*compile_mission(self.legs, self.avoid, self.repeat))

    @classmethod
    def from_text(cls, text: str, predicates: Mapping[str, Any]) -> Mission:
        """Return the mission of a text: "left then (hover or right) then land, avoid crash".

        The words: ``then``, ``or``, ``and`` (in any order), ``not``, ``for 100 steps`` after a
        predicate, ``repeat 2`` after parentheses; and after commas ``avoid crash``, ``repeat 2``
        (the whole mission) or ``repeat forever``. Parts are joined by ``and`` first, then by
        ``or``, then by ``then``.

        Args:
            text: the mission.
            predicates: by name, predicates or functions of observations or of a ``Step``, or
                ``held(...)``.

        Raises:
            DeclarationError: a word is unknown or out of place; the message points at it.
        """
        words = named_predicates(predicates, "Mission.from_text()")
        legs, avoid, repeat = _Parser(text, words).mission()
        return cls(legs, avoid=avoid, repeat=repeat)


@checked_names
def either(*parts: Any) -> Choice:
    """Return a part of a mission that is done where one of its parts is done.

    Args:
        parts: as a mission's legs.

    Raises:
        DeclarationError: it has less than two parts or more than six, or one of a wrong type.
    """
    return Choice(_several(parts, "either()"))


@checked_names
def in_any_order(*parts: Any) -> AnyOrder:
    """Return a part of a mission that is done where all of its parts are done.

    Args:
        parts: as a mission's legs.

    Raises:
        DeclarationError: it has less than two parts or more than six, or one of a wrong type.
    """
    return AnyOrder(_several(parts, "in_any_order()"))


def _needed(part: Part) -> Iterator[Predicate]:
    """Yield the predicates that hold in every way to do a part of a mission."""
    if isinstance(part, InOrder | AnyOrder):
        for inner in part.parts:
            yield from _needed(inner)
    elif not isinstance(part, Choice):
        yield predicate_of(part)


def _several(parts: Sequence[Any], where: str) -> tuple[Part, ...]:
    """Return the parts of a mission's choice, or of one in any order, checked."""
    if not 2 <= len(parts) <= MOST_TOGETHER:
        raise DeclarationError(
            f"{where} has {len(parts)} part{'' if len(parts) == 1 else 's'}; give 2 to "
            f"{MOST_TOGETHER}"
        )
    return tuple(_part(p, where) for p in parts)


def _part(value: Any, where: str) -> Part:
    """Return a value as a part of a mission, with sequences in sequences joined."""
    if isinstance(value, InOrder | Choice | AnyOrder):
        return value
    if isinstance(value, Mission):
        if value.avoid or value.repeat is None:
            raise DeclarationError(
                f"{where}: a mission that is a leg may not avoid or repeat forever; say it of the "
                "whole mission"
            )
        return sequence([value.legs] * value.repeat)
    if isinstance(value, list | tuple):
        if not value:
            raise DeclarationError(f"{where}: a leg is an empty list; give at least one event")
        return sequence([_part(v, where) for v in value])
    return as_event(value, where)


Task = RewardMachine | GoalTask


@checked_names
def as_task(value: Any, predicates: Mapping[str, Any] | None = None) -> Task:
    """Return a task of any value that means one.

    Args:
        value: a ``RewardMachine``, a ``Mission`` or its text, a ``GoalTask``, a predicate (the task
            is done where it holds), also a function of observations, or a function of a ``Step``:
            the reward.
        predicates: by name, for texts.

    Raises:
        DeclarationError: the value is none of these.
    """
    if isinstance(value, RewardMachine | GoalTask):
        return value
    if isinstance(value, str):
        return Mission.from_text(value, predicates or {})
    if isinstance(value, Predicate | Held | Choice | AnyOrder):
        return Mission(value)
    if callable(value) and not isinstance(value, type):
        predicate = Predicate(value)
        return (
            Mission(predicate) if predicate.reads == "obs" else RewardMachine({}, each_step=value)
        )
    raise DeclarationError(
        f"the task is {short(value)}; give a Mission or its text, a RewardMachine, a GoalTask, or "
        "a function of a step that returns the reward"
    )


# The machine of a mission


@dataclass(frozen=True)
class _Fragment:
    """A mission's machine in the making: state 0 is its start, the last one its end.

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
    parts = _in_order(sequence([legs] * (repeat or 1)))
    again = repeat is None
    _check_successions(parts, again)
    fragment = _fragment(InOrder(parts))
    ends = [DONE] * (not again) + [FAILED] * bool(avoid)
    names = (*_unique(fragment.waits), *ends)
    end = fragment.end
    failed = len(names) - 1
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
    """Return names of a mission's states: what each waits for, with a number where two do."""
    names = dict.fromkeys((DONE, FAILED))
    number = dict.fromkeys(waits, 1)
    for wait in waits:
        name = wait
        while name in names:
            number[wait] += 1
            name = f"{wait} #{number[wait]}"
        names[name] = None
    return tuple(names)[2:]


def _fragment(part: Part) -> _Fragment:
    """Return the machine of a part of a mission."""
    if isinstance(part, InOrder):
        # A part that is repeated is one object, and has one fragment.
        fragments = {id(p): _fragment(p) for p in {id(p): p for p in part.parts}.values()}
        return _in_sequence([fragments[id(p)] for p in part.parts])
    if isinstance(part, Choice | AnyOrder):
        return _together([_fragment(p) for p in part.parts], isinstance(part, Choice))
    arrow = Arrow(0, 1, (part,))
    return _Fragment(((arrow,),), (0.0, 1.0), (part.name,), int(isinstance(part, Held)))


def _in_sequence(parts: Sequence[_Fragment]) -> _Fragment:
    """Join each fragment of a mission's machine to the next; all use the same counters."""
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
    """Run a mission's fragments side by side, with own counters, until one or all have ended."""
    offsets = [0, *itertools.accumulate(p.slots for p in parts)]
    start = (0,) * len(parts)
    numbers = {start: 0}
    queue = [start]
    leaving = list[list[tuple[tuple[int, ...], Arrow]]]()
    count = 0
    is_over = any if first_ends else all
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
        events = []
        keeps = set[int]()
        target = []
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
    """Return whether one step would do both parts of a mission: the same predicate.

    A predicate of a step may mean a change, which does not happen twice.
    """
    if not isinstance(a, Predicate) or not isinstance(b, Predicate):
        return False
    return a.reads == b.reads == "obs" and a.function == b.function


# Missions as text

KEYWORDS = ("then", "or", "and", "not", "for", "avoid", "repeat")
RESERVED = (*KEYWORDS, "forever", "steps", "step")
"""Words that are no predicates."""
LONGEST = 10_000
"""The most characters of a text."""
MOST_REPEATS = 1_000
DEEPEST = 50
"""The most parentheses inside one another."""
_TOKEN = re.compile(r"\s*(?:(?P<word>[^\W\d][\w-]*)|(?P<number>\d+)|(?P<sign>[(),]))")


class _Token(NamedTuple):
    """A word, number or sign of a mission's text, with its place."""

    kind: str
    """``word``, ``number``, ``sign`` or ``end``."""
    text: str
    at: int


class _Parser:
    """A parser of a mission's text."""

    def __init__(self, text: str, predicates: Mapping[str, Event]) -> None:
        self.text = fitted(str, text, "a mission")
        self.predicates = predicates
        if len(text) > LONGEST:
            raise DeclarationError(f"a mission has {len(text):,} characters; at most {LONGEST:,}")
        for name in predicates:
            if name in RESERVED:
                raise DeclarationError(
                    f"a predicate is named {name!r}, which is a word of missions; choose another "
                    "name"
                )
        self.tokens = list(self._tokens())
        self.place = self.depth = 0

    def mission(self) -> tuple[Part, list[Predicate], int | None]:
        """Return legs, what is to be avoided, and how often the legs repeat (None: forever)."""
        legs = self.sequence()
        avoid: list[Predicate] = []
        repeat: int | None = 1
        repeated = False
        while self.now.kind != "end":
            self.expect(",", "'then', 'or', 'and', or a comma")
            if self.takes("avoid"):
                avoid += self.avoided()
            elif self.now.text == "repeat":
                if repeated:
                    self.fail("the mission repeats twice; leave one of them out")
                self.take()
                repeated = True
                repeat = None if self.takes("forever") else self.number(1, MOST_REPEATS)
            else:
                self.fail("'avoid' or 'repeat' is expected after a comma")
        return legs, avoid, repeat

    def sequence(self) -> Part:
        """Parse parts that are joined by ``then``."""
        return sequence(self.joined("then", self.choice))

    def choice(self) -> Part:
        """Parse parts that are joined by ``or``."""
        most = f"a choice has at most {MOST_TOGETHER} parts"
        parts = self.joined("or", self.any_order, most)
        return parts[0] if len(parts) == 1 else Choice(tuple(parts))

    def any_order(self) -> Part:
        """Parse parts that are joined by ``and``."""
        most = f"at most {MOST_TOGETHER} parts can be done in any order"
        parts = self.joined("and", self.item, most)
        return parts[0] if len(parts) == 1 else AnyOrder(tuple(parts))

    def joined(self, word: str, parse: Callable[[], Part], most: str = "") -> list[Part]:
        """Parse parts with a word between them; ``most`` says that they are too many."""
        first = self.now
        parts = [parse()]
        while self.takes(word):
            parts.append(parse())
        if most and len(parts) > MOST_TOGETHER:
            self.fail(most, first)
        return parts

    def item(self) -> Part:
        """Parse parentheses, or an event."""
        first = self.now
        if self.takes("("):
            self.depth += 1
            if self.depth > DEEPEST:
                self.fail(f"at most {DEEPEST} parentheses may be inside one another", first)
            inside = self.sequence()
            self.depth -= 1
            self.expect(")", "')', 'then', 'or' or 'and'")
            if self.takes("repeat"):
                return sequence([inside] * self.number(1, MOST_REPEATS))
            return inside
        event = self.event()
        if self.takes("for"):
            if isinstance(event, Held):
                self.fail(f"{event.predicate.name!r} has its number of steps already", first)
            steps = self.number(1, LONGEST_HOLD)
            if not self.takes("steps"):
                self.takes("step")
            event = event if steps == 1 else Held(event, steps)
        if self.now.text == "repeat":
            self.fail("put the part that repeats in parentheses, or a comma before 'repeat'")
        return event

    def event(self) -> Event:
        """Parse a predicate's name, perhaps after ``not``."""
        first = self.now
        negated = first if self.takes("not") else None
        token = self.take()
        if token.kind != "word" or token.text in KEYWORDS:
            self.fail("the name of a predicate is expected here", token)
        if token.text not in self.predicates:
            if not self.predicates:
                name = token.text
                self.fail(
                    f"{name!r} is no known predicate: give predicates={{{name!r}: ...}}", token
                )
            end = suggest(token.text, self.predicates)
            self.fail(f"{token.text!r} is no known predicate{end}", token)
        event = self.predicates[token.text]
        if negated is None:
            return event
        if isinstance(event, Held):
            self.fail("'not' goes before a predicate without a number of steps", negated)
        return ~event

    def avoided(self) -> list[Predicate]:
        """Parse the names after ``avoid``."""
        predicates: list[Predicate] = []
        while True:
            token = self.now
            event = self.event()
            if isinstance(event, Held):
                self.fail("what is avoided must be a predicate of one step", token)
            predicates.append(event)
            if not (self.takes("or") or self.takes("and")):
                return predicates

    @property
    def now(self) -> _Token:
        return self.tokens[self.place]

    def take(self) -> _Token:
        token = self.now
        self.place += token.kind != "end"
        return token

    def takes(self, text: str) -> bool:
        """Return whether the next token is this one, and step over it."""
        if self.now.kind in ("word", "sign") and self.now.text == text:
            self.place += 1
            return True
        return False

    def expect(self, text: str, wanted: str) -> None:
        if not self.takes(text):
            self.fail(f"{wanted} is expected here")

    def number(self, least: int, most: int) -> int:
        """Parse a whole number from ``least`` to ``most``."""
        token = self.take()
        if token.kind != "number":
            self.fail("a whole number is expected here", token)
        # Longer numbers than Python converts are too large in any case.
        if len(token.text) > 12 or not least <= int(token.text) <= most:
            self.fail(f"the number must be from {least:,} to {most:,}", token)
        return int(token.text)

    def fail(self, reason: str, token: _Token | None = None) -> NoReturn:
        """Raise an error whose second line shows the text, and whose third points at a word."""
        token = token or self.now
        shown = self.text.expandtabs(1)
        at = token.at
        # A window of the text, so that the pointer is below its word in any terminal.
        first = max(0, at - 50)
        line = " ".join(shown[first : at + 30].splitlines())
        pointer = " " * (at - first) + "^" * max(1, len(token.text))
        raise DeclarationError(f"mission: {reason}\n  {line}\n  {pointer}")

    def _tokens(self) -> list[_Token]:
        """Return the tokens of the mission's text."""
        tokens: list[_Token] = []
        place = 0
        end = len(self.text.rstrip())
        while place < end:
            match = _TOKEN.match(self.text, place)
            if match is None:
                skipped = len(self.text[place:]) - len(self.text[place:].lstrip())
                wrong = _Token("sign", self.text[place + skipped], place + skipped)
                self.fail("this sign has no meaning in a mission", wrong)
            kind = str(match.lastgroup)
            tokens.append(_Token(kind, match[kind], match.start(kind)))
            place = match.end()
        return [*tokens, _Token("end", "", end)]
