"""The command ``skillweave import-agilerl``.

Nothing here imports torch, as help reads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from tyro.conf import Positional

from skillweave.cli.commands import MaybeOut, Output


@dataclass(frozen=True)
class ImportAgilerlCommand(Output):
    """Convert a checkpoint of AgileRL 0.1 or 1.0, which is a pickle."""

    file: Positional[Path] = tyro.MISSING
    """The checkpoint."""
    trust: bool = False
    """You trust where it comes from; needed, although it is read without running code from it."""
    out: MaybeOut = None
    """The file to write; default: FILE with the suffix .safetensors."""


IMPORT_AGILERL = ImportAgilerlCommand, "skillweave.compat.import_command:import_agilerl"
