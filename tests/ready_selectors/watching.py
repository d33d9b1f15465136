"""What a ready selector remembers after it has watched a step."""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave.policies.core import flat, nested
from skillweave.skills import LastCall, ReadySelector
from skillweave.types import Step


def watched(selector: ReadySelector, memory: Any, step: Step, last: LastCall) -> Any:
    """The memory of a selector after it has watched a step."""
    inside = nested(selector.in_place.start(1), {k: v.copy() for k, v in memory.items()})
    selector.in_place.watch(inside, np.arange(len(last.why)), step, last)
    return flat(inside)
