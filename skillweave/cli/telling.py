"""Tells results to people or programs, and keeps scores in their runs."""

from __future__ import annotations

import json
import sys
from typing import Any

from skillweave.api import Run
from skillweave.cli import commands
from skillweave.runs.command_words import command_words
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import Evaluation
from skillweave.training.evaluation_file import save_evaluation
from skillweave.types import SkillweaveError


def tell(command: commands.Output, data: dict[str, Any], text: str) -> None:
    """Print JSON where it is asked for, else the text."""
    print(json.dumps(data, default=str) if command.json else text)


def save_score(trained: Run, score: Evaluation, seed: int = 0, deterministic: bool = True) -> None:
    """Keep a score in its run for ``info``; one that cannot be written is told all the same."""
    try:
        save_evaluation(RunDirectory.open(trained.path), score, seed, deterministic)
    except SkillweaveError as error:
        print(f"the evaluation is not kept in the run: {error}", file=sys.stderr)


def run_words(run: RunDirectory) -> list[str]:
    """Return where a finished run lies, and commands that show it, as lines."""
    names = ("evaluate", "render", "report")
    commands = [command_words(name, run) for name in names]
    return [f"run     {run.path}", "next    " + "\n        ".join(commands)]
