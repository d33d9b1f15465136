"""The commands ``skillweave handover`` and ``skillweave inputs``.

Nothing here imports torch, as help reads it.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from tyro.conf import Positional

from skillweave.cli.commands import MaybeOut, Output


@dataclass(frozen=True)
class HandoverCommand(Output):
    """Play each ready policy after each other one, and print which can follow which."""

    file: Positional[str] = tyro.MISSING
    """A Python file that defines env, skills, steps, and stays or done: the arguments of
    skillweave.handovers, as variables."""
    calls: int | None = None
    """Entries of each pair; default: the file's, or 20."""
    seed: int | None = None
    """Of robots and cuts; default: the file's, or 0."""
    out: MaybeOut = None
    """A file: .json for all entries, .html for a page, .svg for the matrix."""


@dataclass(frozen=True)
class InputsCommand(Output):
    """Show what ready policies are given as inputs, and which part of it is far off."""

    file: Positional[str] = tyro.MISSING
    """A Python file that defines env, and policy or skills (policies by name), perhaps vary."""
    steps: int = 100
    """The most steps of an episode."""
    episodes: int = 10
    """How many are played."""
    seed: int = 0
    """Of the episodes."""


INPUTS = InputsCommand, "skillweave.robots.handover_command:show_inputs"
HANDOVER = HandoverCommand, "skillweave.robots.handover_command:handover"
