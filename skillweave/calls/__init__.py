"""The log of calls: how it is made and stored, and what it says about skills.

Begin with ``log``; ``recorder`` makes logs, and ``handover`` counts what they say.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.calls.handover import (
        Blame as Blame,
        CallEnds as CallEnds,
        Chain as Chain,
        Handover as Handover,
    )
    from skillweave.calls.log import (
        CallLog as CallLog,
        join as join,
    )
    from skillweave.calls.predicates import (
        Predicate as Predicate,
        held as held,
        successes as successes,
    )
    from skillweave.calls.record import (
        record_calls as record_calls,
    )
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
