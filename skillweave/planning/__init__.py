"""Tasks without training: what is to be done, and plans on a log of calls.

Begin with ``machine``, which says what a task is; ``planner`` solves it. The names of
``skillweave.calls`` are here, too.
"""

from skillweave.calls import (
    Blame,
    CallEnds,
    CallLog,
    Chain,
    Handover,
    Predicate,
    held,
    join,
    record_calls,
    successes,
)
from skillweave.planning.explorer import Explorer
from skillweave.planning.forecast import Forecast
from skillweave.planning.goal import GoalTask, reached
from skillweave.planning.machine import RewardMachine
from skillweave.planning.mission import Mission, as_task, either, in_any_order
from skillweave.planning.planner import Planner

__all__ = [
    "Blame",
    "CallEnds",
    "CallLog",
    "Chain",
    "Explorer",
    "Forecast",
    "GoalTask",
    "Handover",
    "Mission",
    "Planner",
    "Predicate",
    "RewardMachine",
    "as_task",
    "either",
    "held",
    "in_any_order",
    "join",
    "reached",
    "record_calls",
    "successes",
]
