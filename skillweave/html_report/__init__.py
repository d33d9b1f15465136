"""The report: one HTML file that shows a run, or several, in a browser without a network.

Begin with ``single``, the report of a run; ``sections`` has what other packages add to it.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.html_report.sections import Reported as Reported, Section as Section
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
