"""The run directory: what training writes and everything else reads (contract 9).

run.json                     what is trained, with which settings, seeds and versions; phases
metrics.jsonl                a line for every update
lineage.jsonl                a line for every member of every generation, where populations evolve
checkpoint.safetensors       the phase under way, at its latest clean cut (and the one before)
policies/<phase>.safetensors finished phases
policies/<skill>.*            copies of ready policies: .onnx; a torch module's weights
.lock                        empty; locked by the process that trains the run

``manifest`` says what these hold.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from skillweave.algorithms.policy import AgentPolicy, state_from
from skillweave.reading import read_file, shown
from skillweave.runs.checkpoints import Checkpoints
from skillweave.runs.files import (
    TEMPORARY,
    read_signed,
    remove,
    write_bytes,
    write_json,
    write_tensors,
)
from skillweave.runs.jsonl import JsonLines
from skillweave.runs.lock import Lock
from skillweave.runs.manifest import (
    Checkpoint,
    LineageLine,
    MetricsLine,
    identity,
    read_manifest,
    versions,
)
from skillweave.skills.foreign_policy import Foreign, as_recorded
from skillweave.types import Policy, SkillweaveError, unprefixed

S = TypeVar("S")


class RunDirectory:
    """One run on disk. ``manifest`` is the content of ``run.json``."""

    def __init__(self, path: Path, manifest: dict[str, Any]) -> None:
        self.path, self.manifest = path, manifest
        self._metrics = JsonLines(path / "metrics.jsonl", MetricsLine)
        self.lineage = JsonLines(path / "lineage.jsonl", LineageLine)
        self._checkpoints = Checkpoints(path)
        self._lock: Lock | None = None

    @classmethod
    def create(cls, path: str | Path, manifest: dict[str, Any]) -> RunDirectory:
        """A new run.

        Raises:
            SkillweaveError: the directory already holds a run, or other files.
        """
        path = Path(path)
        if (path / "run.json").exists():
            raise SkillweaveError(
                f"{path} already holds a run, which is never overwritten; choose another "
                f"directory, or go on with it: skillweave resume {path}"
            )
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise SkillweaveError(f"{path} exists and is not an empty directory; choose another")
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SkillweaveError(f"could not make {path}: {error.strerror}") from error
        content = {"id": identity(manifest), **manifest}
        run = cls(path, {"versions": versions(), "created": _now(), **content})
        run.save()
        return run

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """An existing run, to read or to train.

        Raises:
            SkillweaveError: there is none, or it is damaged or newer than this Skillweave.
        """
        path = Path(path)
        if not os.path.lexists(path / "run.json"):
            raise SkillweaveError(f"{path} holds no run: there is no {path / 'run.json'}")
        return cls(path, read_manifest(path))

    def begin(self) -> None:
        """Take the run for training: lock it, and clear away what a killed process left.

        Raises:
            SkillweaveError: another process trains it, or it cannot be written.
        """
        if self.finished or self._lock is not None:
            return
        self._lock = Lock(self.path)
        try:
            self.manifest.update(
                read_manifest(self.path)
            )  # another process may have gone on with it
            self._clear()
        except BaseException:
            self.close()
            raise

    def _clear(self) -> None:
        """Remove half-written files, and checkpoints that nothing needs any more."""
        for directory in (self.path, self.path / "policies"):
            for path in directory.glob(TEMPORARY):
                remove(path)
        done = [p["name"] for p in self.manifest["phases"] if p["status"] == "done"]
        self._checkpoints.clear(done)

    def save(self) -> None:
        """Write ``run.json``."""
        self._check()
        write_json(self.path / "run.json", self.manifest, make_directories=False)

    def _check(self) -> None:
        """Raise where the directory was deleted under our hands."""
        if self._lock is not None:
            self._lock.check()

    def phase(self, name: str) -> dict[str, Any]:
        """The manifest's entry of a phase: budget, algorithm, status, steps, seconds."""
        for phase in self.manifest["phases"]:
            if phase["name"] == name:
                found: dict[str, Any] = phase
                return found
        names = ", ".join(p["name"] for p in self.manifest["phases"])
        raise SkillweaveError(f"{self.path} has no phase {shown(name)}; it has: {names}")

    @property
    def finished(self) -> bool:
        """Whether every phase is done."""
        return all(p["status"] == "done" for p in self.manifest["phases"])

    def save_checkpoint(
        self, state: Any, header: dict[str, Any], extra: Mapping[str, Tensor] | None = None
    ) -> None:
        """Write a dataclass of tensors as the latest clean cut; the one before stays beside it.

        ``extra`` holds what else resuming needs: a replay buffer.
        """
        tensors = {f.name: getattr(state, f.name) for f in fields(state)}
        tensors |= {f"extra.{k}": v for k, v in (extra or {}).items()}
        header = self._place(header["phase"]) | header | {"metrics_bytes": self.metrics_size()}
        self._check()
        self._checkpoints.save(tensors, header)

    def drop_checkpoints(self) -> None:
        """Remove the checkpoints of a phase that is done, and said to be so in ``run.json``."""
        self._check()
        self._checkpoints.drop()

    def load_checkpoint(
        self, kind: type[S], phase: str, like: S | None = None, schema: Any = Checkpoint
    ) -> tuple[S, dict[str, Any], dict[str, Tensor]] | None:
        """State, header and extra of a phase's latest good clean cut; None: there is none yet.

        Args:
            like: a state of the shapes and types that it must have.
            schema: of the header.

        Raises:
            SkillweaveError: checkpoints of this phase exist, but none is good.
        """
        found = self._checkpoints.load(phase, schema, self._must_be_ours)
        if found is None:
            return None
        tensors, header, path = found
        extra = unprefixed("extra", tensors)
        tensors = {k: v for k, v in tensors.items() if not k.startswith("extra.")}
        names = {f.name for f in fields(kind)}  # type: ignore[arg-type]
        if names != set(tensors):
            what = "finish the run with the version that began it, or delete the file to begin anew"
            raise SkillweaveError(f"{path} does not hold what this Skillweave resumes from: {what}")
        state = kind(**tensors) if like is None else state_from(tensors, like, str(path))
        return state, header, extra

    def save_policy(self, phase: str, policy: AgentPolicy) -> None:
        """Write the policy of a finished phase; ``save`` then binds it to the run."""
        self._check()
        tensors, header = policy.to_file()
        path = self.policy_path(phase)
        self._make(path.parent)
        sha256 = write_tensors(path, tensors, header | self._place(phase), make_directories=False)
        self.phase(phase)["sha256"] = sha256

    def _place(self, phase: str) -> dict[str, str]:
        """What the header of a phase's file says of where it belongs."""
        run = self.manifest.get("id")  # runs of older versions have none
        return {"phase": phase} | ({} if run is None else {"run": run})

    def _must_be_ours(self, header: dict[str, Any], path: Path) -> None:
        run = self.manifest.get("id")
        if header.get("run", run) != run:
            raise SkillweaveError(f"{path} belongs to another run")

    def load_policy(self, phase: str) -> AgentPolicy:
        """The policy of a finished phase.

        Raises:
            SkillweaveError: the phase is not finished, or its file is damaged.
        """
        entry = self.phase(phase)
        if entry["status"] != "done":
            raise SkillweaveError(
                f"{self.path}: the phase {phase!r} is not finished; skillweave resume {self.path}"
            )
        path = self.policy_path(phase)
        tensors, header, sha256 = read_signed(path)
        if header.get("kind") != "agent":
            raise SkillweaveError(f"{path} holds no agent's policy")
        if header.get("phase", phase) != phase:
            raise SkillweaveError(f"{path} holds the policy of phase {shown(header['phase'])}")
        self._must_be_ours(header, path)
        if entry.get("sha256", sha256) != sha256:
            raise SkillweaveError(
                f"{path} is not the file that the run wrote there: another checksum. Put it back, "
                "or train anew"
            )
        return AgentPolicy.from_file(tensors, header, str(path))

    def keep_policy(self, skill: str, policy: Policy) -> None:
        """Copy into the run what a skill's ready policy acts by, where it is to be copied."""
        if isinstance(policy, Foreign) and (content := policy.content()) is not None:
            path = self._copy_path(skill, policy)
            if not path.exists():  # a run that goes on has it
                self._check()
                self._make(path.parent)
                write_bytes(path, content, make_directories=False)

    def ready_policy(self, skill: str, policy: Policy) -> Policy:
        """A skill's ready policy as it was when the run began.

        Raises:
            SkillweaveError: the policy is another one, and the run holds no copy of its own.
        """
        entry: dict[str, Any] = next((s for s in self.manifest["skills"] if s["name"] == skill), {})

        def read() -> bytes | None:
            assert isinstance(policy, Foreign)
            path = self._copy_path(skill, policy)
            return read_file(path) if path.exists() else None

        return as_recorded(policy, entry.get("policy"), read, f"{self.path}: skill {skill!r}")

    def _make(self, directory: Path) -> None:
        """Make a directory in the run, not the run itself."""
        try:
            directory.mkdir(exist_ok=True)
        except OSError as error:
            raise SkillweaveError(f"could not make {directory}: {error.strerror}") from error

    def _copy_path(self, skill: str, policy: Foreign) -> Path:
        return self.path / "policies" / f"{skill}{policy.suffix}"

    def policy_path(self, phase: str) -> Path:
        """Where a phase's policy lies."""
        return self.path / "policies" / f"{phase}.safetensors"

    def log(self, record: dict[str, Any]) -> None:
        """Append a line to ``metrics.jsonl``."""
        self._check()
        self._metrics.append([record])

    def rewind_metrics(self, size: int | None) -> None:
        """Drop what was written after ``size`` bytes: training is about to write it again."""
        self._metrics.rewind(size)

    def metrics(self) -> Iterator[dict[str, Any]]:
        """The lines of ``metrics.jsonl``; a half-written last line is left out."""
        return self._metrics.read()

    def close(self) -> None:
        """Close the files that lines are appended to, and let others train the run."""
        self._metrics.close()
        self.lineage.close()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def metrics_size(self) -> int:
        """Bytes in ``metrics.jsonl``."""
        return self._metrics.size


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
