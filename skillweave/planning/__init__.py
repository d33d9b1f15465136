"""Tasks without training: what is to be done, and plans on a log of calls.

Begin with ``machine``, which says what a task is; ``planner`` solves it. The names of
``skillweave.calls`` are here, too.
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
    from skillweave.planning.explorer import (
        Explorer as Explorer,
    )
    from skillweave.planning.forecast import (
        Forecast as Forecast,
    )
    from skillweave.planning.goal import (
        GoalTask as GoalTask,
        reached as reached,
    )
    from skillweave.planning.machine import (
        RewardMachine as RewardMachine,
    )
    from skillweave.planning.mission import (
        Mission as Mission,
        as_task as as_task,
        either as either,
        in_any_order as in_any_order,
    )
    from skillweave.planning.planned_run import (
        PlannedRun as PlannedRun,
    )
    from skillweave.planning.planner import (
        Planner as Planner,
    )
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
