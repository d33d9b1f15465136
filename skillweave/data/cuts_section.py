"""The section of a report on the data that a run began with: their calls, as a timeline."""

from __future__ import annotations

from typing import Any

from skillweave.data.timeline import Cuts
from skillweave.html_report import Reported, Section
from skillweave.runs.directory import CUTS
from skillweave.runs.files import read_json
from skillweave.schema import fit

OF_FILE = ("schema", "sha256")
"""What a file has beside its content."""


def section(about: Reported) -> Section | None:
    """Return the section; None: the run did not begin with data that were cut into calls."""
    path = about.run.path / CUTS
    if not path.exists():
        return None

    def convert(content: dict[str, Any]) -> Cuts:
        cuts: Cuts = fit(Cuts, {k: v for k, v in content.items() if k not in OF_FILE}, str(path))
        return cuts

    cuts: Cuts = read_json(path, convert)
    return Section("The data, cut into calls of skills", cuts.html())
