"""Data: episodes that were recorded elsewhere, and skills cut out of them.

``dataset.py`` (``sw.Dataset``) holds episodes, ``minari_files.py`` reads and writes Minari's,
``recording.py`` (``sw.record``) plays a policy, and ``segmenting.py`` (``Hierarchy.segment``) cuts
episodes into calls of skills; ``beginning.py`` and ``cloning.py`` let learners begin as the
recorded actions (``train(data=...)``). Begin with ``dataset.py``.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.data.segmenting import Segments as Segments
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
