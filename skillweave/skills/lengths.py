"""Lengths of calls that a selector chooses together with the skill."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.errors import DeclarationError


@checked_names
class Lengths:
    """Lengths of a call that the selector chooses together with the skill.

    ``Lengths(1, 4, 16)`` are three lengths; ``Lengths(1, ..., 128)`` doubles from 1 to 128.

    Args:
        steps: environment steps, rising; ``...`` between two of them stands for those between, each
            twice the one before.

    Raises:
        DeclarationError: they do not rise, or one is less than 1.
    """

    def __init__(self, *steps: Any) -> None:
        self.steps = tuple(self._all(steps))
        rising = all(a < b for a, b in pairwise(self.steps))
        if not self.steps or self.steps[0] < 1 or not rising:
            raise DeclarationError(
                f"{self._written(steps)}: lengths are environment steps, at least 1, and each is "
                "more than the one before"
            )

    def __repr__(self) -> str:
        return self._written(self.steps)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Lengths) and other.steps == self.steps

    def __hash__(self) -> int:
        return hash(self.steps)

    def _all(self, steps: tuple[Any, ...]) -> Iterator[int]:
        """All lengths, with those that ``...`` stands for."""
        for i, value in enumerate(steps):
            whole = type(value) is int
            between = value is ... and 0 < i < len(steps) - 1
            if not (whole or (between and type(steps[i - 1]) is int)):
                raise DeclarationError(
                    f"{self._written(steps)}: it holds {short(value)}, which is no whole number; "
                    "write Lengths(1, 4, 16) or Lengths(1, ..., 128)"
                )
            if whole:
                yield value
                continue
            last = steps[i - 1]
            following = steps[i + 1]
            while type(following) is int and 0 < 2 * last < following:
                last *= 2
                yield last

    @staticmethod
    def _written(steps: tuple[Any, ...]) -> str:
        return f"Lengths({', '.join('...' if s is ... else short(s) for s in steps)})"
