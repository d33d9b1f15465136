"""The command ``skillweave demo``.

Nothing here imports torch, as help reads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skillweave.cli.commands import Out, Output


@dataclass(frozen=True)
class DemoCommand(Output):
    """Train, score and film two tasks in three minutes: where skills pay, and where not."""

    out: Out = Path("runs/demo")
    """A new directory for runs, films and the report."""
    seed: int = 0
    """The root of every random stream."""
    scale: float = 1.0
    """Multiply every training budget and number of episodes: 0.02 for a quick look."""


DEMO = DemoCommand, "skillweave.demo.demo_command:demo"
