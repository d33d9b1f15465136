"""Loading finished runs: one way for Python, the command line and the hub."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from skillweave.api.adoption import adopted, check_run
from skillweave.api.run import Run
from skillweave.api.running import caller_of, declared_of
from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError
from skillweave.hierarchy import training
from skillweave.hierarchy.declaration import Declaration
from skillweave.messages import as_path, short
from skillweave.runs.command_words import called_by, python_string
from skillweave.runs.directory import RunDirectory
from skillweave.training.plain_agent import PlainAgent

if TYPE_CHECKING:
    from skillweave.api import Agent, Hierarchy


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
    ask: str,
) -> Run:
    """Load a finished run; errors are those of ``load``.

    Args:
        declared: what was trained; None: ``recipe``, or what the run's data say.
        recipe: a shipped recipe, or a file that is trusted.
        ask: what to do where code is needed and was not given, as a sentence.
    """
    from skillweave.api.declared import declared_by

    check_declared(declared)
    run = RunDirectory.open(path)
    if declared is None:
        declared = declared_by(run, recipe, ask=ask)
    declared.validate()
    with called_by(caller_of(declared)):
        if isinstance(declared, Declaration):
            declared = adopted(declared, run)
        else:
            check_run(declared, run)
        return Run(declared_of(declared, run), run.path, training.load(declared, run))


def check_declared(declared: object) -> None:
    """Raise a DeclarationError where something else is given as what was trained."""
    if declared is not None and not isinstance(declared, Declaration | PlainAgent):
        raise DeclarationError(
            f"hierarchy is {short(declared)}; it must be the Hierarchy or Agent that was trained"
        )
