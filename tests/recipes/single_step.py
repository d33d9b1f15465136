"""A step of one environment, written by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave import Step


def step_of(before: Any, after: Any, action: Any = 0, terminated: bool = False) -> Step:
    """The step from ``before`` (1, O) to ``after`` by an action (A,)."""
    no, end = np.zeros(1, bool), np.array([terminated])
    zero, one = np.zeros(1, np.float32), np.ones(1, np.int64)
    return Step(before, np.array([action]), after, zero, end, no, no, one, {})
