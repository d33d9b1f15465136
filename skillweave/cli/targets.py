"""Policies that commands name: a run, a weights file, a recipe's shipped weights."""

from __future__ import annotations

from pathlib import Path

from skillweave._internal import shipped
from skillweave._internal.terminal import say
from skillweave.api import Agent, Hierarchy, Run
from skillweave.api.loading import declared_in, load_from
from skillweave.api.recipe_file import is_env_id
from skillweave.calls.log import lacking_features
from skillweave.cli.commands import Loaded
from skillweave.errors import RunError
from skillweave.hierarchy.weights import HierarchyHeader, open_weights
from skillweave.runs.directory import RunDirectory


def load_target(command: Loaded) -> Run:
    """Return the trained policy that a command names.

    Raises:
        RunError: no such run or weights file, or the policy needs code that was not given.
    """
    path = Path(command.target)
    if command.pretrained:
        return Hierarchy.pretrained(command.target)
    if path.is_dir():
        return load_from(path, recipe=command.recipe)
    if path.suffix == ".safetensors":
        header = open_weights(path)[1]
        named = None
        if isinstance(header, HierarchyHeader):
            named = header.recipe
        elif header.env is not None:
            return Agent.from_weights(path)
        return declared_in(command.recipe or named, command.recipe, str(path)).load_weights(path)
    hint = ""
    if command.target in shipped.names():
        hint = " (add --pretrained for its shipped weights)"
    elif is_env_id(command.target):
        hint = ", but an environment: train a hierarchy on it first (skillweave train FILE.py)"
    raise RunError(f"{command.target} is neither a run nor a weights file{hint}")


def load_with_code(path: Path, recipe: str | None) -> Run:
    """Load the finished run at ``path`` with the code of its shipped recipe, or of ``recipe``.

    Without it, what it means that a call succeeded is unknown, which a notice says.
    """
    run = load_from(path, recipe=recipe or shipped_recipe(RunDirectory.open(path)))
    if isinstance(run.declaration, Hierarchy) and run.declaration.recorded:
        say(
            "the run is loaded without the code of its skills, so their success() is not known; "
            "give it: --recipe FILE.py"
        )
    return run


def shipped_recipe(run: RunDirectory) -> str | None:
    """Return a run's recipe for a command if it is shipped, so that its code is trusted.

    With it, the skills' rewards and successes are known.
    """
    named = run.manifest.recipe
    return named if named in shipped.names() else None


def lacking_words(run: Run) -> str:
    """Return a sentence if a run's skills see images, by which calls cannot be compared."""
    features = run.hierarchy.features
    return lacking_features(features, run.hierarchy.spec.spaces.observation, run.policy)
