"""A notice of a number far beyond all that were seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from skillweave._internal.notices import notice
from skillweave.ops.moments import CLIP, scale_of

FEWEST = 1_000
"""The fewest observations whose range says what is usual."""
BEYOND = 10.0
"""Widths of the range by which a number must be outside: a wrong unit, or -999 for "unknown"."""


@dataclass
class Seen:
    """The range of numbers that were seen; the first one far beyond it is named, once.

    It is far beyond where it is outside by more than ``BEYOND`` widths of the range, and more than
    ``CLIP`` deviations from the mean.
    """

    who: str
    """The start of the message, before the place of the number."""
    mean: Tensor  # (O,)
    var: Tensor  # (O,)
    low: Tensor  # (O,)
    high: Tensor  # (O,)
    count: Tensor | int
    """The number of observations seen; below ``FEWEST`` no number is reported."""

    def __post_init__(self) -> None:
        self._quiet = bool(self.count < FEWEST)

    @cached_property
    def _ends(self) -> tuple[Tensor, Tensor]:
        """Return the least and the largest number that give no notice, by those seen."""
        width = BEYOND * (self.high - self.low)
        away = CLIP * scale_of(self.mean, self.var)
        low = self.low - width
        high = self.high + width
        return low.minimum(self.mean - away), high.maximum(self.mean + away)

    def look(self, numbers: Tensor) -> None:
        """Give the notice if one of ``numbers`` (..., O) is far beyond, unless it was given."""
        if self._quiet or (near := numbers.clamp(*self._ends)).equal(numbers):
            return
        self._quiet = True
        worst = int(((numbers - near).abs() / scale_of(self.mean, self.var)).argmax())
        place = worst % len(self.low)
        notice(
            f"{self.who} {place} is {numbers.flatten()[worst]:g}, but only {self.low[place]:g} to "
            f"{self.high[place]:g} was seen before, so its actions there are guesses. Check the "
            "unit, and whether the value means something else; or collect such values, too"
        )
