"""Why calls end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from skillweave.types import Array, Policy


class CallEnd(IntEnum):
    """Why a call ended."""

    RUNNING = 0
    """It has not ended."""
    OWN = 1
    """The skill's ``termination`` ended it, perhaps in the episode's last step."""
    LIMIT = 2
    """A limit was reached: ``max_steps``, ``call_steps``, or the length that was chosen."""
    INTERRUPTED = 3
    """The selector ended it, as a new decision was worth more."""
    EPISODE = 4
    """The episode ended the call, or has just started: no call runs."""


RUNNING, OWN, LIMIT, INTERRUPTED, EPISODE = map(int, CallEnd)
"""The same as plain integers, with which arrays are compared six times as fast."""


def end_with_episode(end: Array, over: Array) -> None:
    """Set in ``end`` (n,) that episodes ended calls, but for those that ended by themselves.

    Args:
        over: (n,) bool, the episode is over.
    """
    end[over & (end != OWN)] = EPISODE


@dataclass(frozen=True)
class Interruption:
    """When the selector ends a call (Sutton, Precup & Singh 1999, sec. 4)."""

    worth: Callable[[Array], Array]
    """From observations (n, …), the value of each skill and last of a new decision, (n, S + 1), in
    deviations of the return."""
    margin: float
    """How much more a new decision must be worth, in the same unit."""
    critic: Policy | None = None
    """The trained critic, if there is one."""
