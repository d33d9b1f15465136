"""The whole state that a learner ended a stage with, for a later stage in which it learns on."""

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
    """Return whether ``name`` learns in a stage after this one, too."""
    stages = run.manifest["stages"]
    at = [entry["name"] for entry in stages].index(stage)
    return any(name in entry["learns"] for entry in stages[at + 1 :])


def save_state(run: RunDirectory, stage: str, name: str, state: Any) -> None:
    """Write the state, a dataclass of tensors on the CPU, that ``name`` ends a stage with."""
    run.check()
    path = state_path(run, name)
    make_directory(path.parent)
    header = {"learns": name} | run.place(stage)
    write_tensors(path, vars(state), header, make_directories=False)


def load_state(run: RunDirectory, name: str, like: S) -> S | None:
    """Return the state that ``name`` ended its latest stage with; None: none was written.

    A population writes none. Where what was learnt in that stage was
    not kept, its state is none of who goes on.

    Raises:
        RunError: the file is damaged, or belongs elsewhere.
    """
    path = state_path(run, name)
    if not path.exists():
        return None
    tensors, header = read_tensors(path)
    if header.get("learns") != name:
        raise RunError(f"{path} does not hold the state of {name!r}")
    run.must_be_ours(header, path)
    if run.stage(header.get("stage", "")).get("kept", {}).get("kept") == "before":
        return None
    return state_from(tensors, like, str(path))


def drop_states(run: RunDirectory, stage: str) -> None:
    """Remove the states of those who have learnt in this stage and learn no more after it."""
    for name in run.stage(stage)["learns"]:
        if not learns_again(run, stage, name):
            remove(state_path(run, name))
    with suppress(OSError):  # it holds others still, or never was there
        (run.path / "states").rmdir()


def state_path(run: RunDirectory, name: str) -> Path:
    """Return where the state lies that ``name`` ended its latest stage with."""
    return run.path / "states" / f"{file_name(name)}.safetensors"
