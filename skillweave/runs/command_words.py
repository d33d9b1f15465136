"""Commands and lines of Python that messages print, for users to paste."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Literal, Protocol

from skillweave._internal.messages import shown_path
from skillweave.runs.checkpoints import Checkpoints
from skillweave.runs.manifest import Manifest, RepairEntry

Caller = Literal["command line", "hierarchy", "agent", "train_agent"]
"""The user's entry point: a command, or a Python function."""
_CALLER: ContextVar[Caller | None] = ContextVar("CALLER", default=None)
_BEGINS = {
    "hierarchy": "hierarchy.train(",
    "agent": "agent.train(",
    "train_agent": "train_agent(env, algorithm, steps, ",
}


class RunLike(Protocol):
    """A run: its directory and its manifest."""

    path: Path
    manifest: Manifest


@contextmanager
def called_by(caller: Caller) -> Iterator[None]:
    """Set for whom messages print commands: the command line or Python."""
    before = _CALLER.set(_CALLER.get() or caller)
    try:
        yield
    finally:
        _CALLER.reset(before)


def from_command_line() -> bool:
    """Return whether messages print commands: the user typed one."""
    return _CALLER.get() == "command line"


def command_words(name: str, run: RunLike) -> str:
    """Return a command for a run, with the user's file where the command needs it."""
    recipe = run.manifest.recipe or "FILE.py"
    manifest = run.manifest
    needs = manifest.resume_needs_recipe if name == "resume" else manifest.needs_recipe
    needs_file = recipe.endswith(".py") and needs
    words = f"skillweave {name} {shlex.quote(str(shown_path(run.path)))}"
    return words + (f" --recipe {shlex.quote(recipe)}" if needs_file else "")


def resume_words(run: RunLike, *more: str) -> str:
    """Return the command or the line of Python that continues a run.

    ``more``: further arguments of the line of Python.
    """
    if from_command_line():
        return command_words("resume", run)
    for entry in run.manifest.stages:
        if entry.repair is not None and entry.kept is None:
            return repair_words(entry.repair, run)
    seed = [f"seed={run.manifest.seed}"] if run.manifest.seed else []
    return _call(run, ", ".join([python_string(shown_path(run.path)), *seed, "resume=True", *more]))


def repair_words(repair: RepairEntry, run: RunLike) -> str:
    """Return the line of Python that continues a repair."""
    given = [python_string(repair.skill), f"after={python_string(repair.after)}"]
    given.append(f"run_dir={python_string(shown_path(run.path))}")
    given += ["done=..."] if repair.done else []
    return f"run.repair({', '.join(given)}, resume=True)"


def start_words(run: RunLike) -> str:
    """Return the command or the line of Python that starts a new run from this one's policies."""
    if from_command_line():
        recipe = run.manifest.recipe or "RECIPE"
        where = shlex.quote(str(shown_path(run.path)))
        return f"skillweave train {shlex.quote(recipe)} --start-from {where}"
    return _call(run, f"start_from={python_string(shown_path(run.path))}")


def load_words(run: RunLike) -> str:
    """Return the line of Python that loads a finished run, or the command that evaluates it."""
    if from_command_line():
        return command_words("evaluate", run)
    path = python_string(shown_path(run.path))
    return f"sw.load({path}, hierarchy)" if run.manifest.needs_recipe else f"sw.load({path})"


def _call(run: RunLike, arguments: str) -> str:
    plain = run.manifest.hierarchy is None
    caller = _CALLER.get() or ("agent" if plain else "hierarchy")
    flat = ", flat=True" if plain and caller == "hierarchy" else ""
    return f"{_BEGINS[caller]}{arguments}{flat})"


def python_string(text: object) -> str:
    """Return a Python string literal for a line that messages print, in double quotes."""
    return json.dumps(str(text), ensure_ascii=False)


def saved_words(run: RunLike) -> str:
    """Return for a message, beside the command that resumes it, what a stopped run saved."""
    if header := Checkpoints(run.path).latest_header():
        return f"saved at {header.steps:,} steps of {header.stage}"
    stages = run.manifest.stages
    for stage in stages:
        if not stage.done and stage.continued:
            return f"saved at {stage.continued[-1]:,} steps of {stage.name}"
    done = [stage.name for stage in stages if stage.done]
    return f"saved after {done[-1]}" if done else "saved at the start"
