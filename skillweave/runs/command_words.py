"""What people are told to type next."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any, Protocol

from skillweave.runs.checkpoints import Checkpoints


class Told(Protocol):
    """A run: where it is, and what it says."""

    path: Path
    manifest: dict[str, Any]


def command_words(name: str, run: Told) -> str:
    """The words of a command for a run, with the user's own file where it needs that."""
    needs = "resume_needs_recipe" if name == "resume" else "needs_recipe"
    recipe = run.manifest.get("recipe") or "FILE.py"
    own = recipe.endswith(".py") and run.manifest.get(needs, True)
    words = f"skillweave {name} {shlex.quote(str(run.path))}"
    return words + (f" --recipe {shlex.quote(recipe)}" if own else "")


def saved_words(run: Told) -> str:
    """How far a run is saved that was stopped."""
    if at := Checkpoints(run.path).told():
        return f"saved at {at['steps']:,} steps of {at['stage']}"
    done = [stage["name"] for stage in run.manifest["stages"] if stage["status"] == "done"]
    return f"saved after {done[-1]}" if done else "saved at the start"
