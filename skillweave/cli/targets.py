"""Load the policy that a command names: of a run, a weights file, or a shipped recipe."""

from __future__ import annotations

from pathlib import Path

from skillweave import recipes
from skillweave.api import Agent, Hierarchy, Run
from skillweave.api.loading import ASK, declared_in, load_from
from skillweave.cli import commands
from skillweave.errors import RunError
from skillweave.hierarchy.weights import open_weights


def target(command: commands.Watched | commands.Export) -> Run:
    """Return the trained policy that a command names.

    Raises:
        RunError: there is none, or it needs code that was not given.
    """
    path = Path(command.target)
    if command.pretrained:
        return Hierarchy.pretrained(command.target)
    if path.is_dir():
        return load_run(path, command.recipe)
    if path.suffix == ".safetensors":
        header = open_weights(path)[1]
        if header.get("kind") == "agent" and "env" in header:
            return Agent.from_weights(path)
        recipe = command.recipe or header.get("recipe")
        return declared_in(recipe, command.recipe, str(path)).load_weights(path)
    hint = (
        " (add --pretrained for its shipped weights)" if command.target in recipes.names() else ""
    )
    raise RunError(f"{command.target} is neither a run nor a weights file{hint}")


def load_run(path: Path, recipe: str | None) -> Run:
    """Load the finished run at ``path``, with the code of a ``recipe`` if one is given."""
    return load_from(path, recipe=recipe, ask=ASK)


def free(path: Path) -> Path:
    """Return ``path``, or the first of path-2, path-3, … that does not exist."""
    number, candidate = 1, path
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.name}-{number}")
    return candidate
