"""What people are told to type next."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol


class Told(Protocol):
    """A run: where it is, and what it says."""

    path: Path
    manifest: dict[str, Any]


def command_words(name: str, run: Told) -> str:
    """The words of a command for a run, with the user's own file where it needs that."""
    needs = "resume_needs_recipe" if name == "resume" else "needs_recipe"
    recipe = run.manifest.get("recipe") or "FILE.py"
    own = recipe.endswith(".py") and run.manifest.get(needs, True)
    return f"skillweave {name} {run.path}" + (f" --recipe {recipe}" if own else "")
