"""Saved evaluations of a run's whole policy.

``evaluation.json`` holds the run's score: the latest evaluation in which it acted as it does by
default. An evaluation that samples actions on request goes to ``evaluation-sampled.json``, so that
it never replaces the score.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from skillweave._internal.paths import names_in
from skillweave.errors import RunError
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_json, record_in, write_json
from skillweave.runs.hub import must_be_own
from skillweave.runs.trackers import steps_of, trackers_of
from skillweave.schema import Count
from skillweave.training.evaluation import Evaluation

SCORE = "evaluation.json"
SAMPLED = "evaluation-sampled.json"
CHARTS = {"usage": "share", "call_length": "length_mean", "success": "success_rate"}
"""Charts of each skill for trackers, and the key of its report that each shows."""


@dataclass(frozen=True)
class SavedEvaluation:
    """An evaluation that was saved in a run: the content of its file."""

    made: str
    seed: Count
    deterministic: bool
    evaluation: Evaluation
    run: str | None = None
    """The run's ``id``."""

    def to_json(self) -> dict[str, Any]:
        """Return the summary as plain JSON, with time, seed and kind of the evaluation."""
        header = {k: value for k, value in vars(self).items() if k not in ("evaluation", "run")}
        return header | self.evaluation.to_json()


def load_evaluations(run: RunDirectory) -> dict[str, SavedEvaluation]:
    """Return the saved evaluations of a run, by the names that ``Run.info`` gives them.

    Raises:
        RunError: a file is damaged, or belongs to another run.
    """
    known = {
        "evaluation": load_evaluation(run),
        "evaluation_sampled": load_evaluation(run, deterministic=False),
    }
    return {name: saved for name, saved in known.items() if saved is not None}


def save_evaluation(
    run: RunDirectory, evaluation: Evaluation, seed: int, deterministic: bool
) -> None:
    """Write an evaluation into the run, in place of the previous one, and send it to the trackers.

    An evaluation that samples on request (``deterministic=False``) replaces only one of its kind.

    Raises:
        RunError: the disk is full or cannot be written; the previous file is intact. Or
            the run is one of ``from_hub``.
    """
    must_be_own(run.path)
    made = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    saved = SavedEvaluation(made, seed, deterministic, evaluation, run.manifest.id)
    write_json(run.path / _name(deterministic), saved)
    _track(run, evaluation)


def _name(deterministic: bool) -> str:
    """Return the name of the file that holds evaluations of this kind."""
    return SCORE if deterministic else SAMPLED


def _track(run: RunDirectory, evaluation: Evaluation) -> None:
    """Send charts to the trackers: the return; of each skill usage, call length and success."""
    scores = {"return_mean": evaluation.mean}
    skills = evaluation.to_json()["skills"]
    for kind, key in CHARTS.items():
        scores |= {f"{kind}/{k}": v[key] for k, v in skills.items() if v[key] is not None}
    with trackers_of(run) as trackers:
        for tracker in trackers:
            tracker.stage("evaluation", 0)
            tracker.tick("evaluation", steps_of(run), 0.0, scores)


def load_evaluation(run: RunDirectory, *, deterministic: bool = True) -> SavedEvaluation | None:
    """Return the latest evaluation that was saved in the run, or None.

    Args:
        deterministic: True: the run's score. False: the evaluation that sampled on request.

    Raises:
        RunError: the file is damaged, or belongs to another run.
    """
    path = run.path / _name(deterministic)
    if not path.exists():
        return None
    saved: SavedEvaluation = read_json(path, lambda data: record_in(SavedEvaluation, data, path))
    names = {entry.name for entry in run.manifest.skills}
    top_level = {names_in(name)[0] for name in saved.evaluation.skills}
    # A ready hierarchy's own skills are not the run's.
    if saved.run != run.manifest.id or not top_level <= names:
        raise RunError(f"{path} belongs to another run; delete it, and evaluate again")
    return saved
