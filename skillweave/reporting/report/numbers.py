"""Numbers as people read them: digits that fit the scale, percents, and intervals of shares."""

from __future__ import annotations

import math
from collections.abc import Iterable

DIGITS = 3
"""Significant digits."""
MOST_DECIMALS = 4
NOTHING = "–"


def number(value: float | None, scale: float | None = None) -> str:
    """Return a number with three significant digits.

    Args:
        scale: the scale of the numbers beside it, which get as many decimals; None: its own.
    """
    if value is None:
        return NOTHING
    size = abs(value) if scale is None else abs(scale)
    if value and (size < 10**-MOST_DECIMALS or abs(value) >= 1e9):
        return f"{value:.{DIGITS - 1}e}".replace("-", "−")
    places = decimals(size)
    text = f"{round(value, places) + 0.0:,.{places}f}"
    if scale is None and "." in text:
        text = text.rstrip("0").rstrip(".")
    return text.replace("-", "−")


def decimals(size: float) -> int:
    """Return how many decimals a number of this size needs for three significant digits."""
    if size <= 0:
        return 0
    return min(max(DIGITS - 1 - math.floor(math.log10(size)), 0), MOST_DECIMALS)


def scale_of(values: Iterable[float | None]) -> float:
    """Return the largest size among numbers beside each other."""
    return max((abs(value) for value in values if value is not None), default=0.0)


def percent(value: float | None) -> str:
    """Return a share as 42 %; one that is not quite nothing or all does not look like it."""
    if value is None:
        return NOTHING
    if 0 < value < 0.005:
        return "<1 %"
    if 0.995 <= value < 1:
        return ">99 %"
    return f"{100 * value:.0f} %"
