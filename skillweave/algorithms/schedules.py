"""Learning rates that change over the budget: as data, or as a function of the user.

This module does not import torch; see ``config``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from skillweave._internal.messages import error_text, short
from skillweave._internal.named import Named, known_names, named
from skillweave.errors import DeclarationError
from skillweave.schema import (
    LARGEST_FLOAT,
    RECORDED,
    Check,
    NonNegative,
    Positive,
    settings,
)


@settings
class Linear:
    """A learning rate that changes linearly: ``PPO(learning_rate=Linear(3e-4, 0))``.

    Raises:
        DeclarationError: a value is negative, or not finite.
    """

    _from_dict = True

    start: NonNegative
    """The value at the start."""
    end: NonNegative
    """The value at the end of the budget."""

    def __call__(self, remaining: float) -> float:
        """Return the value where this share of the budget remains: 1 at the start, 0 at its end."""
        return self.end + remaining * (self.start - self.end)


LearningRate = Annotated[
    Positive | Linear | Annotated[Callable[[float], float], RECORDED],
    Check(
        "a positive number, Linear(start, end), or a function of the share of the budget that "
        "remains"
    ),
]
"""A number, or a schedule."""


def is_schedule(rate: Any) -> bool:
    """Return whether a learning rate is a schedule, not a number."""
    return isinstance(rate, Linear | str)


def check_rate(config: Any) -> None:
    """Raise a DeclarationError where a schedule in ``learning_rate`` cannot be followed.

    A function is replaced by its name, which leads to it.
    """
    value = config.learning_rate
    where = f"{type(config).__name__}.learning_rate"
    if isinstance(value, str) or (callable(value) and not isinstance(value, Linear)):
        value = named(value, where)
        object.__setattr__(config, "learning_rate", value)
    if isinstance(value, Linear | Named):
        for remaining in (1.0, 0.5, 0.0):
            scheduled(config, remaining)
    if is_schedule(value) and getattr(config, "learning_rate_schedule", "") == "kl":
        raise DeclarationError(
            f"{type(config).__name__}.learning_rate_schedule is 'kl', which adapts a number, but "
            f"learning_rate is {short(value)}: give one of the two"
        )


def scheduled(config: Any, remaining: float) -> float:
    """Return the value of the schedule that ``learning_rate`` is.

    Args:
        remaining: the share of the budget that remains, as in Stable-Baselines3.

    Raises:
        DeclarationError: its function is not loaded, or raised, or did not return a finite number
            of at least 0.
    """
    schedule = config.learning_rate
    where = f"{type(config).__name__}.learning_rate"
    if not callable(schedule):
        raise DeclarationError(
            f"{where} is {schedule!r}, a function of your own, and its code is not loaded: resume "
            "by the declaration that has it, or on the command line by --recipe FILE.py "
            f"(functions that are loaded: {known_names()})"
        )
    try:
        value = schedule(remaining)
        rate = float(value)
    except (Exception, SystemExit) as error:
        message = f"{where}: {schedule}({remaining:g}) raised {error_text(error)}"
        raise DeclarationError(message) from error
    if not 0.0 <= rate < LARGEST_FLOAT:
        raise DeclarationError(
            f"{where}: {schedule}({remaining:g}) returned {short(value)}; it must return a finite "
            "number of at least 0"
        )
    return rate


def start_rate(config: Any) -> float:
    """Return the number that a state keeps for ``learning_rate``: a schedule's first value."""
    rate = config.learning_rate
    if not is_schedule(rate):
        return float(rate)
    return scheduled(config, 1.0) if callable(rate) else 0.0


def own_schedules(config: Any) -> bool:
    """Return whether learning by these settings needs a function of the user."""
    return isinstance(getattr(config, "learning_rate", None), str)
