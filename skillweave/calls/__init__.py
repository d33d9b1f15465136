"""The log of calls: how it is made and stored, and what it says about skills.

Begin with ``log``; ``recorder`` makes logs, and ``handover`` counts what they say.
"""

from skillweave.calls.handover import Blame, CallEnds, Chain, Handover
from skillweave.calls.log import CallLog, join
from skillweave.calls.predicates import Predicate, held, successes
from skillweave.calls.record import record_calls

__all__ = [
    "Blame",
    "CallEnds",
    "CallLog",
    "Chain",
    "Handover",
    "Predicate",
    "held",
    "join",
    "record_calls",
    "successes",
]
