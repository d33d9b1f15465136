"""The commands for the Hugging Face Hub: ``push`` and ``pull``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from skillweave.api.hub import pull_run, push_run
from skillweave.cli import commands
from skillweave.cli.targets import free
from skillweave.cli.telling import run_words
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import check_name, hub


def push(command: commands.Push) -> tuple[dict[str, Any], str]:
    """Put a run on the hub; return the result as JSON and for people."""
    _no_bars()
    pushed = push_run(command.run, command.name, command.private)
    lines = [f"{pushed['url']}: {len(pushed['files'])} files", *pushed["missing"]]
    lines.append(f"load it: skillweave.from_hub({command.name!r})")
    return pushed, "\n".join(lines)


def pull(command: commands.Pull) -> tuple[dict[str, Any], str]:
    """Copy a run from the hub; return its new place as JSON and for people."""
    _no_bars()
    name = check_name(command.name).partition("/")[2]
    path = pull_run(command.name, command.out or free(Path("runs") / name), command.revision)
    return {"path": str(path)}, "\n".join(run_words(RunDirectory.open(path)))


def _no_bars() -> None:
    """Keep the hub's library from drawing a bar for each file."""
    hub()  # a missing extra is reported
    importlib.import_module("huggingface_hub.utils").disable_progress_bars()
