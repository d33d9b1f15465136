"""Commands and lines of Python that messages print, for people to paste."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal, Protocol

from skillweave.messages import shown_path
from skillweave.runs.checkpoints import Checkpoints

Caller = Literal["command line", "hierarchy", "agent", "train_agent"]
"""What the user called: a command, or a function of Python."""
_CALLER: ContextVar[Caller | None] = ContextVar("CALLER", default=None)
_BEGINS = {
    "hierarchy": "hierarchy.train(",
    "agent": "agent.train(",
    "train_agent": "train_agent(env, algorithm, steps, ",
}


class Told(Protocol):
    """A run: where it is, and what it says."""

    path: Path
    manifest: dict[str, Any]


@contextmanager
def called_by(caller: Caller) -> Iterator[None]:
    """Let messages print what fits the caller; the outermost caller counts."""
    before = _CALLER.set(_CALLER.get() or caller)
    try:
        yield
    finally:
        _CALLER.reset(before)


def from_command_line() -> bool:
    """Return whether the user typed a command."""
    return _CALLER.get() == "command line"


def command_words(name: str, run: Told) -> str:
    """Return a command for a run, with the user's own file where it needs that."""
    needs = "resume_needs_recipe" if name == "resume" else "needs_recipe"
    recipe = run.manifest.get("recipe") or "FILE.py"
    own = recipe.endswith(".py") and run.manifest.get(needs, True)
    words = f"skillweave {name} {shlex.quote(str(shown_path(run.path)))}"
    return words + (f" --recipe {shlex.quote(recipe)}" if own else "")


def resume_words(run: Told, *more: str) -> str:
    """Return what continues a run: a command, or a line of Python, as the user works.

    ``more``: further arguments, of Python.
    """
    if from_command_line():
        return command_words("resume", run)
    seed = [f"seed={run.manifest['seed']}"] if run.manifest.get("seed") else []
    return _call(run, ", ".join([python_string(shown_path(run.path)), *seed, "resume=True", *more]))


def start_words(run: Told) -> str:
    """Return what begins a new run with the policies of this one."""
    if from_command_line():
        recipe = run.manifest.get("recipe") or "RECIPE"
        where = shlex.quote(str(shown_path(run.path)))
        return f"skillweave train {shlex.quote(recipe)} --start-from {where}"
    return _call(run, f"start_from={python_string(shown_path(run.path))}")


def load_words(run: Told) -> str:
    """Return what loads a finished run, or shows how it does."""
    if from_command_line():
        return command_words("evaluate", run)
    path = python_string(shown_path(run.path))
    return f"sw.load({path}, hierarchy)" if run.manifest.get("needs_recipe") else f"sw.load({path})"


def _call(run: Told, arguments: str) -> str:
    plain = run.manifest.get("kind") == "agent"
    caller = _CALLER.get() or ("agent" if plain else "hierarchy")
    flat = ", flat=True" if plain and caller == "hierarchy" else ""
    return f"{_BEGINS[caller]}{arguments}{flat})"


def python_string(text: object) -> str:
    """Return a string of Python, in double quotes."""
    return json.dumps(str(text), ensure_ascii=False)


def saved_words(run: Told) -> str:
    """Return how far a run is saved that was stopped."""
    if at := Checkpoints(run.path).told():
        return f"saved at {at['steps']:,} steps of {at['stage']}"
    stages = run.manifest["stages"]
    for stage in stages:
        if stage["status"] != "done" and (continued := stage.get("continued")):
            return f"saved at {continued[-1]:,} steps of {stage['name']}"
    done = [stage["name"] for stage in stages if stage["status"] == "done"]
    return f"saved after {done[-1]}" if done else "saved at the start"
