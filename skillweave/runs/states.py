"""The full state of a learner at the end of a stage, for a later stage in which it continues."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from skillweave.algorithms.policy import state_from
from skillweave.errors import RunError
from skillweave.runs.directory import RunDirectory, file_name
from skillweave.runs.files import make_directory, read_tensors, remove, write_tensors

S = TypeVar("S")


def learns_again(run: RunDirectory, stage: str, name: str) -> bool:
    """Return whether ``name`` also learns in a later stage."""
    stages = run.manifest.stages
    at = [entry.name for entry in stages].index(stage)
    return any(name in entry.learns for entry in stages[at + 1 :])


def save_state(run: RunDirectory, stage: str, name: str, state: Any) -> None:
    """Write the final state of ``name`` in a stage, a dataclass of tensors on the CPU."""
    run.check()
    path = state_path(run, name)
    make_directory(path.parent)
    header = {"learns": name} | run.place(stage)
    write_tensors(path, vars(state), header, make_directories=False)


def load_state(run: RunDirectory, name: str, like: S) -> S | None:
    """Return the final state of ``name`` in its latest stage; None: it cannot continue from one.

    A population writes none, and a stage whose result was not kept has none to continue from.

    Raises:
        RunError: the file is damaged, or belongs to another learner or run.
    """
    path = state_path(run, name)
    if not path.exists():
        return None
    tensors, header = read_tensors(path)
    if header.get("learns") != name:
        raise RunError(f"{path} does not hold the state of {name!r}")
    run.must_be_ours(header.get("run"), path)
    if run.stage(header.get("stage", "")).undone:
        return None
    return state_from(tensors, like, str(path))


def drop_states(run: RunDirectory, stage: str) -> None:
    """Remove the states of learners of this stage that do not learn in a later one."""
    for name in run.stage(stage).learns:
        if not learns_again(run, stage, name):
            remove(state_path(run, name))
    with suppress(OSError):  # it still holds others, or never existed
        (run.path / "states").rmdir()


def state_path(run: RunDirectory, name: str) -> Path:
    """Return the path of the final state of ``name`` in its latest stage."""
    return run.path / "states" / f"{file_name(name)}.safetensors"
