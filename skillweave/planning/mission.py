"""Missions (sequences, choices and repetitions of events), and every kind of task in one form."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.errors import DeclarationError
from skillweave.planning.goal import GoalTask
from skillweave.planning.machine import RewardMachine
from skillweave.planning.mission_text import parse
from skillweave.planning.parts import (
    MOST_TOGETHER,
    AnyOrder,
    Choice,
    InOrder,
    Part,
    compile_mission,
    sequence,
)
from skillweave.planning.predicates import (
    Held,
    Predicate,
    as_event,
    as_predicate,
    named_predicates,
)
from skillweave.schema import AtLeastOne, fitted


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
        repeat: how many times the legs are done; None: again and again, without an end.

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
        self._build(compile_mission(self.legs, self.avoid, self.repeat))

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
        legs, avoid, repeat = parse(text, named_predicates(predicates, "Mission.from_text()"))
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
    """Yield the predicates that hold in every way to do a part."""
    if isinstance(part, InOrder | AnyOrder):
        for inner in part.parts:
            yield from _needed(inner)
    elif isinstance(part, Held):
        yield part.predicate
    elif isinstance(part, Predicate):
        yield part


def _several(parts: Sequence[Any], where: str) -> tuple[Part, ...]:
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
