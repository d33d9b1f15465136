"""Know and plan: tasks without training, logs of calls, and planning on them."""

from skillweave.planning.goal import Goal, reached
from skillweave.planning.machine import RewardMachine
from skillweave.planning.mission import Mission, either, in_any_order
from skillweave.planning.predicates import Predicate, held, successes
from skillweave.planning.task import as_task

__all__ = [
    "Goal",
    "Mission",
    "Predicate",
    "RewardMachine",
    "as_task",
    "either",
    "held",
    "in_any_order",
    "reached",
    "successes",
]
