"""Ready policies of one robot: which can follow which.

Begin with ``measuring``, which has ``sw.handovers``; ``chains`` plays calls one after another, and
``measured`` is the table.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.robots.inputs import (
        InputPart as InputPart,
        InputSheet as InputSheet,
        OutputLimits as OutputLimits,
    )
    from skillweave.robots.measured import (
        Between as Between,
        ChainChance as ChainChance,
        Entry as Entry,
        HandoverTable as HandoverTable,
        Pair as Pair,
    )
    from skillweave.robots.measuring import MeasuredHandovers as MeasuredHandovers
    from skillweave.robots.read_mapping import ReadMapping as ReadMapping
    from skillweave.robots.remedies import (
        Effect as Effect,
        Remedies as Remedies,
        Tried as Tried,
    )
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
