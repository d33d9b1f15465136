"""Results of commands, for people and for programs; scores are kept in their runs."""

from __future__ import annotations

from typing import Any

from skillweave._internal.messages import shown_path
from skillweave._internal.terminal import say
from skillweave.api import Run
from skillweave.errors import RunError
from skillweave.runs.command_words import command_words
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import Evaluation
from skillweave.training.evaluation_file import save_evaluation

Result = tuple[dict[str, Any], str | None]
"""The result of a command for programs, and for people; None: they have seen it."""


def save_score(trained: Run, score: Evaluation, seed: int = 0, deterministic: bool = True) -> None:
    """Keep the score that a command prints in its run, for ``skillweave info``."""
    try:
        save_evaluation(RunDirectory.open(trained.path), score, seed, deterministic)
    except RunError as error:
        say(f"the evaluation is not kept in the run: {error}")


def run_words(run: RunDirectory) -> list[str]:
    """Return lines: the place of a finished run, and commands that show it."""
    names = ("evaluate", "render", "report")
    commands = [command_words(name, run) for name in names]
    return [f"run     {shown_path(run.path)}", "next    " + "\n        ".join(commands)]
