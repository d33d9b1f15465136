"""What a command names: a run, a weights file, a shipped recipe."""

from __future__ import annotations

from pathlib import Path

from skillweave import recipes
from skillweave.api import Agent, Hierarchy, Run
from skillweave.cli import commands
from skillweave.hierarchy.weights import open_weights
from skillweave.runs.directory import RunDirectory
from skillweave.types import SkillweaveError


def target(command: commands.Watched | commands.Export) -> Run:
    """The trained policy that a command names.

    Raises:
        SkillweaveError: there is none, or it needs code that was not given.
    """
    path = Path(command.target)
    if command.pretrained:
        return Hierarchy.pretrained(command.target)
    if path.is_dir():
        return declared_by_run(path, command.recipe).load(path)
    if path.suffix == ".safetensors":
        header = open_weights(path)[1]
        if header.get("kind") == "agent" and "env" in header:
            return Agent.from_weights(path)
        recipe = command.recipe or header.get("recipe")
        return _declared(recipe, command.recipe, path).load_weights(path)
    hint = (
        " (add --pretrained for its shipped weights)" if command.target in recipes.names() else ""
    )
    raise SkillweaveError(f"{command.target} is neither a run nor a weights file{hint}")


def declared_by_run(
    path: Path, recipe: str | None, needs: str = "needs_recipe"
) -> Hierarchy | Agent:
    """What a run was trained from; code never comes from inside the run.

    Raises:
        SkillweaveError: it needs code that was not given.
    """
    manifest = RunDirectory.open(path).manifest
    if recipe is None and not manifest.get(needs, True):
        kind = Agent if manifest["kind"] == "agent" else Hierarchy
        return kind.from_manifest(manifest)
    return _declared(recipe or manifest.get("recipe"), recipe, path)


def _declared(recipe: str | None, given: str | None, path: Path) -> Hierarchy:
    if recipe is not None and (given is not None or recipe in recipes.names()):
        return recipes.load(recipe)
    made = f"in {recipe}" if recipe else "in Python"
    raise SkillweaveError(
        f"{path} was declared {made}, and needs that code. Point to the file that "
        "defines it, if you trust it: --recipe FILE.py"
    )
