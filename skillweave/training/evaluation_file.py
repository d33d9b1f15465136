"""Saved evaluations of a run's whole policy.

``evaluation.json`` holds the run's score: the latest evaluation in which it acted as it does by
default. An evaluation that samples actions on request goes to ``evaluation-sampled.json``, so that
it never replaces the score.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any, NotRequired, TypedDict

from skillweave.errors import RunError
from skillweave.reading import fit
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_json, write_json
from skillweave.runs.hub import must_be_own
from skillweave.runs.trackers import steps_of, trackers_of
from skillweave.settings import Count
from skillweave.training.evaluation import Evaluation

SCORE, SAMPLED = "evaluation.json", "evaluation-sampled.json"
CHARTS = {"usage": "share", "call_length": "length_mean", "success": "success_rate"}
"""What trackers are sent of each skill, and where it stands in its report."""


class EvaluationFile(TypedDict):
    """What the file holds."""

    run: NotRequired[str]
    made: str
    seed: Count
    deterministic: bool
    evaluation: Evaluation


@dataclass(frozen=True)
class SavedEvaluation:
    """An evaluation that was saved in a run."""

    made: str
    seed: int
    deterministic: bool
    evaluation: Evaluation

    def to_json(self) -> dict[str, Any]:
        """The summary as plain JSON, with how it was made."""
        how = {"made": self.made, "seed": self.seed, "deterministic": self.deterministic}
        return how | self.evaluation.to_json()


def save_evaluation(
    run: RunDirectory, evaluation: Evaluation, seed: int, deterministic: bool
) -> None:
    """Write it into the run, in place of the one before, and send it to the run's trackers.

    One that samples on request (``deterministic=False``) replaces only the one that sampled before.

    Raises:
        RunError: the disk is full or cannot be written; what was there is intact. Or the
            run is one of ``from_hub``.
    """
    must_be_own(run.path)
    found = EvaluationFile(
        made=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        seed=seed,
        deterministic=deterministic,
        evaluation=evaluation,
    )
    if "id" in run.manifest:
        found["run"] = run.manifest["id"]
    plain = {**found, "evaluation": asdict(evaluation)}
    write_json(run.path / _name(deterministic), plain, make_directories=False)
    _track(run, evaluation)


def _name(deterministic: bool) -> str:
    """Return the name of the file that holds evaluations of this kind."""
    return SCORE if deterministic else SAMPLED


def _track(run: RunDirectory, evaluation: Evaluation) -> None:
    """Charts of the whole policy: its return, and of each skill usage, call length and success."""
    scores = {"return_mean": evaluation.mean}
    told = evaluation.to_json()["skills"]
    for kind, key in CHARTS.items():
        scores |= {f"{kind}/{k}": v[key] for k, v in told.items() if v[key] is not None}
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
    data = read_json(path, lambda data: fit(EvaluationFile, data, str(path)))
    found: EvaluationFile = fit(EvaluationFile, data, str(path))
    names = {entry["name"] for entry in run.manifest.get("skills", [])}
    ours = found.get("run") == run.manifest.get("id")
    told = {name.partition("/")[0] for name in found["evaluation"].skills}
    if not ours or not told <= names:  # a ready hierarchy's own skills are not the run's
        raise RunError(f"{path} belongs to another run; delete it, and evaluate again")
    return SavedEvaluation(
        found["made"], found["seed"], found["deterministic"], found["evaluation"]
    )
