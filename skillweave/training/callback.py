"""A user's function that receives reports and checkpoints of training, and can stop a stage."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.tracebacks import place
from skillweave.errors import DeclarationError
from skillweave.runs.command_words import resume_words, saved_words
from skillweave.runs.directory import RunDirectory
from skillweave.runs.trackers import Listener


@checked_names
@dataclass(frozen=True)
class TrainEvent:
    """A report of training, or a checkpoint, as ``train(callback=...)`` gets it."""

    kind: Literal["report", "checkpoint"]
    """A report comes after each update, with replay about every 1,000 steps; a checkpoint when it
    is written."""
    stage: str
    """The stage that trains: "agent", "selector", "together" or a skill's name."""
    steps: int
    """Environment steps of this stage so far."""
    budget: int
    """Environment steps that this stage may take."""
    total_steps: int
    """Environment steps of all stages so far."""
    progress: float
    """Share of the whole run's budget that is done, from 0 to 1; stages that ended early count
    whole."""
    metrics: dict[str, float]
    """The numbers of the report, as in ``metrics.jsonl``; of a checkpoint, those of the report
    before it. ``eval_return`` and ``eval_success`` are there where an evaluation was due."""
    run_dir: Path
    """The run's directory."""


Callback = Callable[[TrainEvent], Any]
"""A function of one event; where it returns False, the stage ends."""


class TrainCallback(Listener):
    """The listener that calls a user's function.

    Args:
        function: checked by ``check_callback``.
        run: the run that trains.
    """

    def __init__(self, function: Callback, run: RunDirectory) -> None:
        self._function = function
        self._run = run
        self.stopped = False
        """True after the function returned False in this stage."""

    def stage(self, name: str, budget: int) -> None:
        """Prepare for a stage that starts or continues."""
        self.stopped = False

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Call the function with a report."""
        self._call("report", name, steps, metrics)

    def checkpoint(self, name: str, steps: int, metrics: Mapping[str, float | None]) -> None:
        """Call the function with a checkpoint."""
        self._call("checkpoint", name, steps, metrics)

    def _call(
        self,
        kind: Literal["report", "checkpoint"],
        name: str,
        steps: int,
        metrics: Mapping[str, float | None],
    ) -> None:
        """Call the user's function with an event; stop the stage where it returns False."""
        stages = self._run.manifest.stages
        done = [s for s in stages if s.done]
        budget = self._run.stage(name).budget
        passed = sum(s.budget for s in done) + min(steps, budget)
        event = TrainEvent(
            kind=kind,
            stage=name,
            steps=steps,
            budget=budget,
            total_steps=sum(s.steps or 0 for s in done) + steps,
            progress=passed / sum(s.budget for s in stages),
            metrics={k: float(v) for k, v in metrics.items() if v is not None},
            run_dir=self._run.path,
        )
        try:
            result = self._function(event)
        except Exception as error:
            # Raise the same exception, so that Optuna and others still catch their own.
            where = place(error)
            error.add_note(
                "The callback of train() raised this"
                + (f" ({where})" if where else "")
                + f", so training stopped. The run is {saved_words(self._run)}. Continue: "
                + resume_words(self._run, "callback=callback")
            )
            raise
        if isinstance(result, bool | np.bool_) and not result:
            self.stopped = True


def check_callback(callback: Any) -> None:
    """Raise a DeclarationError where ``callback`` is no function of one event, and not None."""
    if callback is None:
        return
    advice = "give a function of one event: def callback(event): ..."
    if not callable(callback):
        raise DeclarationError(f"callback is {short(callback)}; {advice}")
    if isinstance(callback, type):
        raise DeclarationError(
            f"callback is the class {callback.__name__}; give a function of one event, or an "
            "object of a class with __call__(self, event)"
        )
    if inspect.iscoroutinefunction(callback) or inspect.isgeneratorfunction(callback):
        kind = "a generator" if inspect.isgeneratorfunction(callback) else "an async function"
        raise DeclarationError(f"callback is {kind}, which would not run when called; {advice}")
    try:
        signature = inspect.signature(callback)
    except (TypeError, ValueError):  # of some functions written in C
        return
    try:
        signature.bind(object())
    except TypeError:
        raise DeclarationError(
            f"callback takes {signature}, but it is called with one event: def callback(event): ..."
        ) from None
