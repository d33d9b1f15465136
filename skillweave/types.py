"""Types for annotations: policies, steps, arrays, and the objects that methods return.

Users import from here; the library imports each type from the module that defines it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from skillweave._internal.policy_protocol import Memory as Memory, Memoryless as Memoryless
from skillweave._internal.public import lazy
from skillweave.policies.core import Step as Step

if TYPE_CHECKING:
    from skillweave._internal.policy_protocol import Policy as Policy
    from skillweave._internal.seeding import Seeds as Seeds
    from skillweave.export.write import Export as Export
    from skillweave.hierarchy.policy import HierarchyPolicy as HierarchyPolicy
    from skillweave.policies.core import Array as Array, LastCall as LastCall
    from skillweave.training.callback import TrainEvent as TrainEvent
    from skillweave.training.evaluation import Evaluation as Evaluation
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
