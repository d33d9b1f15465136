"""Results, one JSON file for each (suite, task, agent, seed): what is there is not run again."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import benchmarks
import skillweave
from skillweave.errors import SkillweaveError
from skillweave.runs.directory import RunDirectory


@dataclass(frozen=True)
class Result:
    """The result of one agent on one task from one seed."""

    suite: str
    task: str
    agent: str
    seed: int
    score: float
    steps: int
    """Environment steps of training on this task, as they were made."""
    budget: int
    """Environment steps that were asked for."""
    seconds: float
    curve: list[tuple[int, float]] = field(default_factory=list)
    """Steps, and the score of the evaluation that was made then."""
    scores: list[float] = field(default_factory=list)
    """Of each episode that the score is the mean of."""
    usage: dict[str, float] = field(default_factory=dict)
    """The share of steps of each skill."""
    code: str = ""
    """``CODE``, if all that it follows from was made by one code; else empty."""


class Results:
    """A folder of results.

    Args:
        folder: is made where it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, suite: str, task: str, agent: str, seed: int) -> Path:
        """Return where a result is."""
        return self.folder / suite / task / agent / f"{seed}.json"

    def run_path(self, suite: str, task: str, agent: str, seed: int) -> Path:
        """Return the directory of its training."""
        return self.file(suite, task, agent, seed).with_suffix(".run")

    def find(self, suite: str, task: str, agent: str, seed: int, budget: int) -> Result | None:
        """Return a result that is there.

        Raises:
            SkillweaveError: the file is damaged, or was made with another budget.
        """
        path = self.file(suite, task, agent, seed)
        if not path.exists():
            return None
        found = read(path)
        if found.budget != budget:
            raise SkillweaveError(
                f"{path} is of {found.budget:,} steps, but {budget:,} are asked for: give another "
                "folder with --out, or remove it"
            )
        return found

    def save(self, result: Result) -> None:
        """Write a result; a process that is killed leaves none, or all of it."""
        path = self.file(result.suite, result.task, result.agent, result.seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps(asdict(result), indent=1))
        os.replace(part, path)

    def begin(self, run: Path) -> None:
        """Note by which code a training is begun, before it is, or goes on."""
        if not run.exists():
            run.parent.mkdir(parents=True, exist_ok=True)
            run.with_suffix(".code").write_text(CODE)

    def begun_by(self, run: Path) -> str:
        """Return the checksum of the code that started a finished training; empty: not noted."""
        note = run.with_suffix(".code")
        found = note.read_text() if note.exists() else ""
        note.unlink(missing_ok=True)
        return found

    def all(self, suite: str) -> list[Result]:
        """Return all results of a suite."""
        return [read(path) for path in sorted((self.folder / suite).glob("*/*/*.json"))]


def read(path: Path) -> Result:
    """Return the result of a file.

    Raises:
        SkillweaveError: it is damaged.
    """
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        found["curve"] = [(int(steps), float(score)) for steps, score in found["curve"]]
        return Result(**found)
    except (ValueError, TypeError, KeyError) as error:
        raise SkillweaveError(f"{path} is damaged ({error}): remove it, and run again") from error


def checksum(*packages: Path) -> str:
    """Return a checksum of all Python files in folders."""
    found = hashlib.sha256()
    for root in packages:
        for path in sorted(root.rglob("*.py")):
            found.update(f"{path.relative_to(root.parent)}\0".encode() + path.read_bytes())
    return found.hexdigest()


CODE = checksum(*(Path(str(p.__file__)).parent for p in (skillweave, benchmarks)))
"""Of the library with its recipes, and of the benchmarks, as this process has them. Any change of
a file counts, comments too; versions of other packages do not."""


def of_other_code(results: Sequence[Result]) -> str:
    """Return a sentence on the results of other code than today's; empty without any."""
    others = [r for r in results if r.code != CODE]
    if not others:
        return ""
    named = ", ".join(f"{r.task} {r.agent} {r.seed}" for r in others[:5])
    named += ", …" if len(others) > 5 else ""
    return (
        f"{len(others)} of these {len(results)} results were made by other code than today's "
        f"({named}): to measure today's, give another folder with --out"
    )


def hours(results: Sequence[Result]) -> float:
    """Return what these results took, in hours, one after another: trainings and scores."""
    own = {(r.suite, r.task, r.seed, r.seconds): r.seconds for r in results}  # F3 has one of F0's
    return sum(own.values()) / 3600.0


def curve_of(path: Path, unit: float, stages: tuple[str, ...]) -> list[tuple[int, float]]:
    """Return what the periodic evaluations of a run found: steps of the whole run, and scores.

    Args:
        stages: whose evaluations are of the task.
    """
    run = RunDirectory.open(path)
    before, total = {}, 0
    for stage in run.manifest.stages:
        before[stage.name] = total
        total += stage.steps or 0
    found = []
    for line in (path / "metrics.jsonl").read_text().splitlines():
        entry = json.loads(line)
        if entry.get("stage") in stages and "eval_return" in entry:
            found.append((before[entry["stage"]] + entry["steps"], entry["eval_return"] / unit))
    return found
