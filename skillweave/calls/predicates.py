"""Predicates: named yes-or-no functions of observations or steps, of which tasks are made."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.calls.columns import CallColumns
from skillweave.errors import DeclarationError, RunError, SkillError
from skillweave.policies.core import Array, Step
from skillweave.policies.selectors import function_name
from skillweave.schema import AtLeastOne, fitted
from skillweave.skills import Skill
from skillweave.skills.outputs import call_checked

Reads = Literal["obs", "step"]
WORD = r"[^\W\d][\w-]*"
"""The pattern of a predicate's name in a text."""
LONGEST_HOLD = 100_000
"""The most steps of ``held``: no episode is longer."""


@checked_names
class Predicate:
    """A named yes-or-no function, evaluated after every step.

    Combine predicates with ``&``, ``|`` and ``~``.

    Args:
        function: of observations (n, *obs_shape), which are those after the step, or of a ``Step``;
            it returns (n,) bool. A Dict's observations are parts by key: ``obs["place"]`` is
            (n, …).
        name: used in messages and texts; default: the function's name.
        reads: "obs" or "step", the function's argument. None: "step" if its first argument is
            named ``step`` or annotated ``Step``, else "obs".

    Raises:
        DeclarationError: it is not a function, or ``reads`` is another word.
    """

    def __init__(
        self, function: Callable[[Any], Any], name: str = "", reads: Reads | None = None
    ) -> None:
        if not callable(function) or isinstance(function, type):
            raise DeclarationError(
                f"a predicate is {short(function)}; give a function of observations or of a step"
            )
        fitted(Reads | None, reads, "a predicate's reads")
        self.function = function
        self.name = name or function_name(function)
        self.reads: Reads = reads or _argument(function)

    def __repr__(self) -> str:
        return f"<Predicate {self.name!r} of {self.reads}>"

    def __and__(self, other: Any) -> Predicate:
        return self._joined(other, "and", np.logical_and)

    def __or__(self, other: Any) -> Predicate:
        return self._joined(other, "or", np.logical_or)

    def __invert__(self) -> Predicate:
        return _of(np.logical_not, f"not {self.name}", self)

    def _joined(self, other: Any, word: str, join: Callable[..., Array]) -> Predicate:
        second = as_predicate(other, f"{self.name} {word} ...")
        return _of(join, f"({self.name} {word} {second.name})", self, second)

    def holds(self, step: Step) -> Array:
        """Return where the predicate is true after a ``step``, (n,) bool.

        Raises:
            SkillError: the function failed, or returned another shape or type.
        """
        if self.reads == "obs":
            return self.at(step.next_obs)
        return call_checked(self.function, step, bool, f"task: {self.name}()")

    def at(self, obs: Array) -> Array:
        """Return where a predicate of observations is true, (n,) bool, for ``obs`` (n, …).

        Raises:
            DeclarationError: the predicate reads steps.
            SkillError: the function failed, or returned another shape or type.
        """
        if self.reads != "obs":
            raise DeclarationError(
                f"the predicate {self.name!r} reads a step, but only an observation is known here"
            )
        try:
            return call_checked(self.function, obs, bool, f"task: {self.name}()")
        except SkillError as error:
            if (hint := _hint(error)) is None:
                raise
            raise SkillError(f"{str(error).rstrip('.')}; {hint}") from error.__cause__


@dataclass(frozen=True)
class Held:
    """The event that a predicate has been true in each of the latest ``steps`` steps."""

    predicate: Predicate
    steps: int
    slot: int = 0
    """In a machine, the column of its counter in a task's state, after the first."""

    @property
    def name(self) -> str:
        """The event in words."""
        return f"{self.predicate.name} for {self.steps} steps"

    def __and__(self, other: Any) -> Any:
        raise self._not_combined()

    __rand__ = __or__ = __ror__ = __and__

    def __invert__(self) -> Any:
        raise self._not_combined()

    def _not_combined(self) -> DeclarationError:
        return DeclarationError(
            f"held({self.predicate.name}, {self.steps}) cannot be combined with &, | or ~; combine "
            "predicates inside it: held(a & b, 100)"
        )


Event = Predicate | Held


def predicate_of(event: Event) -> Predicate:
    """Return the predicate that an event reads."""
    return event.predicate if isinstance(event, Held) else event


@checked_names
def held(predicate: Any, steps: int) -> Event:
    """Return the event that a predicate has been true for a number of steps without a gap.

    The steps count from the moment at which the task waits for the event.

    Args:
        predicate: a ``Predicate``, or a function of observations or of a step.
        steps: at least 1.

    Raises:
        DeclarationError: the predicate is no function, or the number is not whole.
    """
    predicate = as_predicate(predicate, "held()")
    steps = fitted(AtLeastOne, steps, "held(): steps")
    if steps > LONGEST_HOLD:
        raise DeclarationError(
            f"held(): steps is {steps:,}; an episode has at most {LONGEST_HOLD:,} steps"
        )
    return predicate if steps == 1 else Held(predicate, steps)


def as_predicate(value: Any, where: str) -> Predicate:
    """Convert a predicate, or a function, to a ``Predicate``; ``where`` begins messages."""
    if isinstance(value, Predicate):
        return value
    if isinstance(value, Held):
        raise DeclarationError(
            f"{where}: {value.name} is an event over several steps; give a predicate"
        )
    if not callable(value) or isinstance(value, type):
        raise DeclarationError(
            f"{where}: {short(value)} is no predicate; give a function of observations or of a step"
        )
    return Predicate(value)


def as_event(value: Any, where: str) -> Event:
    """Convert a predicate, a function or ``held(...)`` to an event; ``where`` begins messages."""
    return value if isinstance(value, Held) else as_predicate(value, where)


def named_predicates(values: Mapping[str, Any], where: str) -> dict[str, Event]:
    """Return events by the names under which a text refers to them."""
    named: dict[str, Event] = {}
    for name, value in fitted(Mapping[str, Any], values, f"{where}: predicates").items():
        event = as_event(value, f"{where}: {short(name)}")
        if not re.fullmatch(WORD, name):
            raise DeclarationError(
                f"{where}: a predicate is named {short(name)}; a name is one word that begins with "
                "a letter"
            )
        if isinstance(event, Predicate) and event.name != name:
            event = Predicate(event.function, name, event.reads)
        named[name] = event
    return named


@contextmanager
def reads_of(log: CallColumns) -> Iterator[None]:
    """Raise a RunError where a predicate, asked inside, reads ``info`` that the log does not have.

    Raises:
        RunError: the key, and how to record it.
    """
    try:
        yield
    except SkillError as error:
        cause = error.__cause__
        key = cause.args[0] if isinstance(cause, KeyError) and cause.args else None
        if not isinstance(key, str) or key in log.info:
            raise
        raise RunError(
            f"the task reads info[{key!r}], which the log does not have; record it: "
            f"record_calls(..., info=[{key!r}])"
        ) from error


@checked_names
def successes(skills: Iterable[Skill]) -> dict[str, Predicate]:
    """Return the ``success`` of each skill that defines it, as predicates by the skills' names.

    Args:
        skills: of a hierarchy, ``hierarchy.skills``.

    Returns:
        Predicates of a step, for ``Mission.from_text`` and for handover matrices.
    """
    return {
        skill.name: Predicate(skill.success, skill.name, "step")
        for skill in skills
        if skill.defines("success")
    }


def _of(join: Callable[..., Array], name: str, *parts: Predicate) -> Predicate:
    """Return the predicate that joins the answers of its parts."""
    reads: Reads = "obs" if all(part.reads == "obs" for part in parts) else "step"
    ask = Predicate.at if reads == "obs" else Predicate.holds
    return Predicate(lambda x: join(*(ask(part, x) for part in parts)), name, reads)


def _hint(error: SkillError) -> str | None:
    """Return advice for a function that took observations for a ``Step``, or None."""
    cause = error.__cause__
    fields = {field.name for field in dataclasses.fields(Step)}
    if isinstance(cause, AttributeError) and cause.name in fields:
        return (
            "it was given observations, (n, ...), as its argument is not named 'step': write "
            "lambda step: ..., annotate it with Step, or write Predicate(function, reads='step')"
        )
    return None


def _argument(function: Callable[[Any], Any]) -> Reads:
    """Return the input of a function, steps or observations, by its first argument."""
    try:
        first = next(iter(inspect.signature(function).parameters.values()), None)
    except (TypeError, ValueError):
        return "obs"
    if first is None:
        return "obs"
    annotated = first.annotation in (Step, "Step", "sw.Step", "skillweave.Step")
    return "step" if first.name == "step" or annotated else "obs"
