"""The commands that talk to the Hugging Face Hub: ``push`` and ``pull``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skillweave.api.hub import pull_run, push_run
from skillweave.cli import commands
from skillweave.cli.targets import free
from skillweave.runs.hub import check_name, hub


def push(command: commands.Push) -> tuple[dict[str, Any], str]:
    """Put a run on the hub; what happened, as JSON and for people."""
    _progress(command)
    told = push_run(command.run, command.name, command.private)
    lines = [f"{told['url']}: {len(told['files'])} files", *told["missing"]]
    lines.append(f"load it: skillweave.from_hub({command.name!r})")
    return told, "\n".join(lines)


def pull(command: commands.Pull) -> tuple[dict[str, Any], str]:
    """Copy a run from the hub; where it is now, as JSON and for people."""
    _progress(command)
    name = check_name(command.name).partition("/")[2]
    path = pull_run(command.name, command.out or free(Path("runs") / name), command.revision)
    return {"path": str(path)}, f"run     {path}  (skillweave info|evaluate|render {path})"


def _progress(command: commands.Output) -> None:
    """Let the hub's library draw its bars, or not."""
    if command.quiet or command.json:
        hub().utils.disable_progress_bars()
