"""Output for people: progress, films, figures, and the report of a run in ``report``.

Begin with ``report/single``; ``report/facts`` has the facts that all of them print.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.reporting.curves_figure import plot_curves as plot_curves
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
