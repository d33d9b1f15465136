"""The errors that Skillweave raises, as a tree: catch one kind, or all as ``SkillweaveError``.

Each message is one sentence for people: what is wrong, where, and what to do about it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from skillweave._internal.tracebacks import ShortTraceback
from skillweave.policies.acting_errors import (
    DeclarationError as DeclarationError,
    PolicyError as PolicyError,
    RunError as RunError,
    SkillError as SkillError,
    SkillweaveError as SkillweaveError,
    printable,
)

SkillweaveError._render_traceback_ = ShortTraceback._render_traceback_  # type: ignore[attr-defined]


for _kind in (SkillweaveError, DeclarationError, PolicyError, RunError, SkillError):
    _kind.__module__ = __name__  # where users find it


class EnvError(SkillweaveError):
    """An environment cannot be made or used, or broke Gymnasium's contract."""


class TrainingError(SkillweaveError):
    """Training cannot continue: a loss is not finite, memory is short, or a process was lost."""


class MissingExtra(SkillweaveError, ImportError):
    """A feature needs an optional dependency; the message names the extra to install."""

    def __init__(self, feature: str, extra: str) -> None:
        super().__init__(f"{feature} needs the extra '{extra}': pip install 'skillweave[{extra}]'")

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling, because the arguments differ from the message."""
        return make_error, ("MissingExtra", str(self))


@contextmanager
def needs_extra(feature: str, extra: str) -> Iterator[None]:
    """Raise MissingExtra where a package that is imported within the block is not installed."""
    try:
        yield
    except ImportError as error:
        raise MissingExtra(feature, extra) from error


class Interrupted(ShortTraceback, KeyboardInterrupt):
    """Training was interrupted; the message says what is saved and how to continue.

    Args:
        message: the text to show.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(printable(message))


KINDS = {
    kind.__name__: kind
    for kind in (
        SkillweaveError,
        DeclarationError,
        EnvError,
        SkillError,
        PolicyError,
        TrainingError,
        RunError,
        MissingExtra,
    )
}


def kind_of(error: SkillweaveError) -> str:
    """Return the name of an error's kind, one of ``KINDS``."""
    return next(c.__name__ for c in type(error).__mro__ if KINDS.get(c.__name__) is c)


def make_error(kind: str, message: str) -> SkillweaveError:
    """Return an error of the kind with this name."""
    error = KINDS[kind].__new__(KINDS[kind])
    SkillweaveError.__init__(error, message)  # MissingExtra takes no message
    return error


def reworded(error: SkillweaveError, message: str) -> SkillweaveError:
    """Return an error of the same kind with another message."""
    return make_error(kind_of(error), message)
