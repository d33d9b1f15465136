"""Steps and walks whose numbers are chosen by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave.planning import Predicate
from skillweave.types import Array, Step


def step_to(after: Any, before: Any = None, **more: Any) -> Step:
    """A step of n environments to the observations ``after`` (n, D)."""
    after = np.asarray(after, np.float32)
    before = np.zeros_like(after) if before is None else np.asarray(before, np.float32)
    n = len(after)
    no = np.zeros(n, bool)
    values = {
        "action": np.zeros(n, np.int64),
        "reward": np.zeros(n, np.float32),
        "terminated": no,
        "truncated": no,
        "timed_out": no,
        "elapsed": np.ones(n, np.int64),
        "info": {},
    } | more
    return Step(obs=before, next_obs=after, **values)


def column(i: int) -> Any:
    """A predicate: number ``i`` of the observation is not 0."""

    def holds(obs: Array) -> Array:
        return obs[:, i] != 0

    holds.__name__ = "abcdef"[i]
    return holds


def at(*places: float) -> Predicate:
    """The predicate that the first number is one of these."""
    return Predicate(lambda obs: np.isin(obs[:, 0], places), f"at {places}", "obs")
