"""Tasks without training: logs of calls, what they say about skills, and plans on them.

Begin with ``calls``, the log; ``machine`` says what a task is, and ``planner`` solves it.
"""

from skillweave.planning.calls import CallLog, join
from skillweave.planning.explorer import Explorer
from skillweave.planning.forecast import Forecast
from skillweave.planning.goal import GoalTask, reached
from skillweave.planning.handover import Blame, CallEnds, Chain, Handover
from skillweave.planning.machine import RewardMachine
from skillweave.planning.mission import Mission, as_task, either, in_any_order
from skillweave.planning.planner import Planner
from skillweave.planning.predicates import Predicate, held, successes
from skillweave.planning.record import record_calls

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
