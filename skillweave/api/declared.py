"""What a run was trained from, found by its manifest; code never comes from inside the run."""

from __future__ import annotations

from skillweave.api import Agent, Hierarchy
from skillweave.api.recipe_file import hierarchy_in
from skillweave.errors import RunError
from skillweave.runs.directory import RunDirectory
from skillweave.shipped import names

ASK = "Point to the file that defines it, if you trust it: --recipe FILE.py"


def declared_by(
    run: RunDirectory, recipe: str | None = None, needs: str = "needs_recipe", ask: str = ASK
) -> Hierarchy | Agent:
    """What a run was trained from.

    Args:
        recipe: a shipped recipe, or a file that is trusted; None: as the run says.
        needs: which field of the manifest says whether code is needed.
        ask: what to do where it was not given, as a sentence.

    Raises:
        RunError: it needs code that was not given.
    """
    manifest = run.manifest
    if recipe is None and not manifest.get(needs, True):
        kind = Agent if manifest["kind"] == "agent" else Hierarchy
        return kind.from_manifest(manifest)
    return declared_in(recipe or manifest.get("recipe"), recipe, str(run.path), ask)


def declared_in(recipe: str | None, given: str | None, where: str, ask: str = ASK) -> Hierarchy:
    """The hierarchy of a recipe: a shipped one, or the one that was ``given``.

    Raises:
        RunError: it is neither; the message begins with ``where``.
    """
    if recipe is not None and (given is not None or recipe in names()):
        return hierarchy_in(recipe, Hierarchy)
    made = f"in {recipe}" if recipe else "in Python"
    raise RunError(f"{where} was declared {made}, and needs that code. {ask}")
