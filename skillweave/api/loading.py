"""Finished runs for Python, the command line and the hub: load one, or finish it first."""

from __future__ import annotations

from pathlib import Path

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import as_path, short
from skillweave._internal.shipped import names
from skillweave.api import Agent, Hierarchy, Run, run_of
from skillweave.api.applying import load_policy
from skillweave.api.recipe_file import hierarchy_in
from skillweave.api.running import existing_run, start_run
from skillweave.api.train_options import TrainOptions
from skillweave.errors import DeclarationError, RunError
from skillweave.runs import hub
from skillweave.runs.command_words import python_string
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Manifest
from skillweave.schema import as_json
from skillweave.training.plain_agent import Declared

ASK = "Point to the file that defines it, if you trust it: --recipe FILE.py"
ASK_FROM_HUB = (
    "Pass the hierarchy that was trained, if you have its code and trust it: "
    "from_hub(name, hierarchy)"
)


@checked_names
def load(run_dir: str | Path, hierarchy: Hierarchy | Agent | None = None) -> Run:
    """Load a finished run.

    Code that lies in the run, or that it names, is never executed.

    Args:
        run_dir: its directory.
        hierarchy: the ``Hierarchy`` or ``Agent`` that was trained. It is needed where the run's
            policy acts by Python code: ``initiation``, ``termination``, reflexes, functions,
            environments and wrappers that are no plain id. Not for shipped recipes.

    Returns:
        The run.

    Raises:
        RunError: there is no run, it is not finished or damaged, it is one of another
            declaration, or it needs code that was not given.
    """
    path = as_path(run_dir, "run_dir")
    ask = f"Pass the hierarchy that was trained: sw.load({python_string(path)}, hierarchy)"
    return load_from(path, hierarchy, ask=ask)


def load_from(
    path: Path,
    declared: Hierarchy | Agent | None = None,
    *,
    recipe: str | None = None,
    ask: str = ASK,
) -> Run:
    """Load a finished run; errors are those of ``load``.

    Args:
        declared: the declaration; None: ``recipe``, or the declaration in the run's data.
        recipe: a shipped recipe, or a file that is trusted.
        ask: a sentence for the error: how to give the code that is needed.
    """
    check_declared(declared)
    if declared is None:
        declared = declared_by(RunDirectory.open(path), recipe, ask=ask)
    return run_of(load_policy(declared, path))


@checked_names
def from_hub(
    name: str, hierarchy: Hierarchy | Agent | None = None, *, revision: str | None = None
) -> Run:
    """Load a run from the Hugging Face Hub, as ``hierarchy.load`` loads one from a folder.

    Only data comes from there: safetensors and JSON, checked like any run's files. It needs the
    extra ``hub``. The files are kept where ``huggingface_hub`` keeps its own (``HF_HOME``), and
    without a network a run is loaded from there. Nothing is written into that copy: to save an
    evaluation or a report in the run, take a copy of your own (``skillweave pull``).

    Args:
        name: ``owner/name``.
        hierarchy: what was trained, where acting needs its Python code; None: not needed, or a
            recipe that is shipped.
        revision: a branch, a tag or a commit; None: the latest.

    Returns:
        The finished run.

    Raises:
        RunError: there is no such run, it holds a file that is not data, it is damaged, it
            needs code that was not given, or the hub does not answer.
        MissingExtra: the extra 'hub' is not installed.
    """
    check_declared(hierarchy)
    return load_from(hub.download(name, revision), hierarchy, ask=ASK_FROM_HUB)


def finished_run(declared: Hierarchy, content: Manifest, run_dir: Path) -> Run:
    """Return the finished run of this manifest in ``run_dir``; train what is missing.

    Raises:
        RunError: the directory holds a run of another manifest.
    """
    run = existing_run(declared, content, run_dir)
    if run is None:
        options = TrainOptions(run_dir, seed=content.seed, quiet=True)
        return run_of(start_run(declared, content, options))
    return declared.load(run_dir) if run.finished else declared.resume(run_dir, quiet=True)


def declared_by(
    run: RunDirectory, recipe: str | None = None, to_train: bool = False, ask: str = ASK
) -> Hierarchy | Agent:
    """Return the declaration that a run was trained from; code never comes from inside the run.

    Args:
        recipe: a shipped recipe, or a file that is trusted; None: the one that the run names.
        to_train: train it further, which may need code where acting does not.
        ask: a sentence for the error: how to give the code.

    Raises:
        RunError: it needs code that was not given.
    """
    manifest = run.manifest
    needed = manifest.resume_needs_recipe if to_train else manifest.needs_recipe
    if recipe is None and not needed:
        kind = Agent if manifest.hierarchy is None else Hierarchy
        return kind.from_manifest(as_json(manifest))
    return declared_in(recipe or manifest.recipe, recipe, str(run.path), ask)


def declared_in(recipe: str | None, given: str | None, where: str, ask: str = ASK) -> Hierarchy:
    """Return the hierarchy of a recipe: a shipped one, or the one that was ``given``.

    Raises:
        RunError: it is neither; the message begins with ``where``.
    """
    if recipe is not None and (given is not None or recipe in names()):
        return hierarchy_in(recipe, Hierarchy)
    made = f"in {recipe}" if recipe else "in Python"
    raise RunError(f"{where} was declared {made}, and needs that code. {ask}")


def check_declared(declared: object) -> None:
    """Raise a DeclarationError where ``declared`` is no declaration."""
    if declared is not None and not isinstance(declared, Declared):
        raise DeclarationError(
            f"hierarchy is {short(declared)}; it must be the Hierarchy or Agent that was trained"
        )
