"""Keywords of an environment that are drawn anew for each robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.schema import fitted


class Variation:
    """Ranges of an environment's keywords, from which each robot draws its own.

    Args:
        ranges: by keyword: a tuple of the lowest and the highest number (whole ones where both
            are), or a list of values.

    Raises:
        DeclarationError: a range is neither; the message names the keyword.
    """

    def __init__(self, ranges: Mapping[str, Any]) -> None:
        self.ranges = dict(fitted(Mapping[str, Any], ranges, "vary"))
        for name, values in self.ranges.items():
            _check(name, values)

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """Return a value of each keyword."""
        return {name: _drawn(values, rng) for name, values in self.ranges.items()}

    def __str__(self) -> str:
        return ", ".join(f"{name} {_words(values)}" for name, values in self.ranges.items())


def with_settings(spec: EnvSpec, settings: Mapping[str, Any]) -> EnvSpec:
    """Return an environment with the keywords that were drawn for a robot."""
    return replace(spec, kwargs={**spec.kwargs, **settings})


def _check(name: str, values: Any) -> None:
    if isinstance(values, list) and values:
        return
    pair = isinstance(values, tuple) and len(values) == 2 and all(map(_is_number, values))
    if not pair or not values[0] <= values[1]:
        raise DeclarationError(
            f"vary[{name!r}] is {short(values)}; it must be (lowest, highest), two numbers, or a "
            "list of values to draw from"
        )


def _is_number(value: Any) -> bool:
    plain = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return plain and bool(np.isfinite(value))


def _drawn(values: Any, rng: np.random.Generator) -> Any:
    if isinstance(values, list):
        value = values[int(rng.integers(len(values)))]
        return value.item() if isinstance(value, np.generic) else value
    low, high = values
    if isinstance(low, int | np.integer) and isinstance(high, int | np.integer):
        return int(rng.integers(low, high + 1))
    return float(rng.uniform(low, high))


def _words(values: Any) -> str:
    if isinstance(values, list):
        return "one of " + short(values)
    return f"{values[0]:g} to {values[1]:g}"
