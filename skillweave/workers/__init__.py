"""Collectors elsewhere: in processes of this machine, or on other machines by Ray.

Begin with ``host``, what all of them are asked and how lost ones are made again; ``placement``
chooses where they run.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.workers.cluster import Ray as Ray
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
