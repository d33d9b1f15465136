"""Print results for people or programs, and keep scores in their runs."""

from __future__ import annotations

import json
from typing import Any

from skillweave._internal.messages import shown_path
from skillweave._internal.terminal import put_result, say
from skillweave.api import Run
from skillweave.cli import commands
from skillweave.errors import RunError
from skillweave.runs.command_words import command_words
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import Evaluation
from skillweave.training.evaluation_file import save_evaluation


def print_result(command: commands.Output, data: dict[str, Any], text: str) -> None:
    """Print JSON if ``--json`` is given, else the text."""
    print_line(as_json(data) if command.json else text)


def as_json(data: object) -> str:
    """Return one line of JSON, without any character that a terminal obeys."""
    return json.dumps(data, default=str).replace("\x7f", "\\u007f")


def print_line(text: str = "") -> None:
    """Print a line of results.

    Raises:
        RunError: standard output cannot be written.
    """
    try:
        put_result(text)
    except OSError as error:
        raise RunError(f"could not write to standard output: {error.strerror}") from error


def save_score(trained: Run, score: Evaluation, seed: int = 0, deterministic: bool = True) -> None:
    """Keep a score in its run for ``info``; print a warning if it cannot be written."""
    try:
        save_evaluation(RunDirectory.open(trained.path), score, seed, deterministic)
    except RunError as error:
        say(f"the evaluation is not kept in the run: {error}")


def run_words(run: RunDirectory) -> list[str]:
    """Return lines: the place of a finished run, and commands that show it."""
    names = ("evaluate", "render", "report")
    commands = [command_words(name, run) for name in names]
    return [f"run     {shown_path(run.path)}", "next    " + "\n        ".join(commands)]
