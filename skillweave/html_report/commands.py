"""The commands ``skillweave report`` and ``skillweave compare``.

Nothing here imports torch, as help reads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from skillweave.cli.commands import Coded, MaybeOut, OfEpisodes, OfRun, Out, Output, Runs


@dataclass(frozen=True)
class ReportCommand(OfEpisodes, Coded, OfRun):
    """Write one HTML file about a run: film, timeline of calls, curves, skills, settings."""

    out: MaybeOut = None
    """The file to write; default: report.html in the run."""
    episodes: int = 20
    """Episodes to play, with seeds that training never used."""
    films: int = 3
    """Number of these episodes to film, from the worst to the best; 0: no film."""


@dataclass(frozen=True)
class CompareCommand(Output):
    """Write one HTML file that compares runs; those that differ by their seed alone are a group."""

    runs: Runs = tyro.MISSING
    """Directories of runs, or of sweeps."""
    out: Out = Path("compare.html")
    """The file to write."""


REPORT = ReportCommand, "skillweave.html_report.report_command:report"
COMPARE = CompareCommand, "skillweave.html_report.report_command:compare"
