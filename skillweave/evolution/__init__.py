"""Evolution: a population that learns in stacks, is compared, selected and mutated.

Begin with ``population``, a generation from start to end; ``stage`` trains one in a run.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.evolution.config import (
        Evolution as Evolution,
        Mutations as Mutations,
        Range as Range,
        Tournament as Tournament,
        Truncation as Truncation,
    )
    from skillweave.evolution.selection import Heir as Heir, ParentSelection as ParentSelection
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
