"""The run directory: what training writes and everything else reads (contract 9).

run.json                     what is trained, with which settings, seeds and versions; phases
metrics.jsonl                a line for every update
lineage.jsonl                a line for every member of every generation, where populations evolve
checkpoint.safetensors       the phase under way, at its latest clean cut (and the one before)
policies/<phase>.safetensors finished phases
policies/<skill>.*            copies of ready policies: .onnx; a torch module's weights
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Mapping
from dataclasses import fields
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from skillweave.algorithms.policy import AgentPolicy
from skillweave.runs.files import (
    read_json,
    read_tensors,
    write_bytes,
    write_json,
    write_tensors,
)
from skillweave.runs.lines import JsonLines
from skillweave.skills.foreign import Foreign, as_recorded
from skillweave.types import Policy, SkillweaveError

S = TypeVar("S")


class RunDirectory:
    """One run on disk. ``manifest`` is the content of ``run.json``."""

    def __init__(self, path: Path, manifest: dict[str, Any]) -> None:
        self.path, self.manifest = path, manifest
        self._metrics = JsonLines(path / "metrics.jsonl")
        self.lineage = JsonLines(path / "lineage.jsonl")

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
        run = cls(path, {"versions": versions(), "created": _now(), **manifest})
        run.save()
        return run

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """An existing run.

        Raises:
            SkillweaveError: there is none, or it is damaged or newer than this Skillweave.
        """
        path = Path(path)
        if not (path / "run.json").exists():
            raise SkillweaveError(f"{path} holds no run: there is no {path / 'run.json'}")
        manifest = read_json(path / "run.json")
        for field in (
            "kind",
            "env",
            "env_kwargs",
            "seed",
            "cut_every",
            "skills",
            "call_steps",
            "greedy_skills",
            "needs_recipe",
            "phases",
        ):
            if field not in manifest:
                raise SkillweaveError(f"{path / 'run.json'} is damaged: no field {field!r}")
        return cls(path, manifest)

    def save(self) -> None:
        """Write ``run.json``."""
        write_json(self.path / "run.json", self.manifest)

    def phase(self, name: str) -> dict[str, Any]:
        """The manifest's entry of a phase: budget, algorithm, status, steps, seconds."""
        for phase in self.manifest["phases"]:
            if phase["name"] == name:
                found: dict[str, Any] = phase
                return found
        names = ", ".join(p["name"] for p in self.manifest["phases"])
        raise SkillweaveError(f"{self.path} has no phase {name!r}; it has: {names}")

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
        target = self.path / "checkpoint.safetensors"
        fresh = self.path / "checkpoint.new.safetensors"
        write_tensors(fresh, tensors, header | {"metrics_bytes": self.metrics_size()})
        if target.exists():
            os.replace(target, self.path / "checkpoint.previous.safetensors")
        os.replace(fresh, target)

    def load_checkpoint(
        self, kind: type[S], phase: str
    ) -> tuple[S, dict[str, Any], dict[str, Tensor]] | None:
        """State, header and extra of a phase's latest good clean cut; None: there is none yet.

        Raises:
            SkillweaveError: checkpoints of this phase exist, but all are damaged.
        """
        problems = []
        for name in ("checkpoint.safetensors", "checkpoint.previous.safetensors"):
            path = self.path / name
            if not path.exists():
                continue
            try:
                tensors, header = read_tensors(path)
            except SkillweaveError as error:
                problems.append(str(error))
                continue
            if header.get("phase") != phase:
                continue
            cut = len("extra.")
            extra = {k[cut:]: tensors.pop(k) for k in list(tensors) if k.startswith("extra.")}
            names = {f.name for f in fields(kind)}  # type: ignore[arg-type]
            if names != set(tensors):
                raise SkillweaveError(f"{path} does not hold a {kind.__name__} of this Skillweave")
            return kind(**tensors), header, extra
        if problems:
            raise SkillweaveError(
                "; ".join(problems) + f". Delete it to train the phase {phase!r} from its start"
            )
        return None

    def save_policy(self, phase: str, policy: AgentPolicy) -> None:
        """Write the policy of a finished phase."""
        write_tensors(self.policy_path(phase), *policy.to_file())

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
        tensors, header = read_tensors(path)
        if header.get("kind") != "agent":
            raise SkillweaveError(f"{path} holds no agent's policy")
        return AgentPolicy.from_file(tensors, header, str(path))

    def keep_policy(self, skill: str, policy: Policy) -> None:
        """Copy into the run what a skill's ready policy acts by, where it is to be copied."""
        if isinstance(policy, Foreign) and (content := policy.content()) is not None:
            path = self._copy_path(skill, policy)
            if not path.exists():  # a run that goes on has it
                write_bytes(path, content)

    def ready_policy(self, skill: str, policy: Policy) -> Policy:
        """A skill's ready policy as it was when the run began.

        Raises:
            SkillweaveError: the policy is another one, and the run holds no copy of its own.
        """
        entry: dict[str, Any] = next((s for s in self.manifest["skills"] if s["name"] == skill), {})

        def read() -> bytes | None:
            assert isinstance(policy, Foreign)
            path = self._copy_path(skill, policy)
            return path.read_bytes() if path.exists() else None

        return as_recorded(policy, entry.get("policy"), read, f"{self.path}: skill {skill!r}")

    def _copy_path(self, skill: str, policy: Foreign) -> Path:
        return self.path / "policies" / f"{skill}{policy.suffix}"

    def policy_path(self, phase: str) -> Path:
        """Where a phase's policy lies."""
        return self.path / "policies" / f"{phase}.safetensors"

    def log(self, record: dict[str, Any]) -> None:
        """Append a line to ``metrics.jsonl``."""
        self._metrics.append([record])

    def rewind_metrics(self, size: int | None) -> None:
        """Drop what was written after ``size`` bytes: training is about to write it again."""
        self._metrics.rewind(size)

    def metrics(self) -> Iterator[dict[str, Any]]:
        """The lines of ``metrics.jsonl``; a half-written last line is left out."""
        return self._metrics.read()

    def close(self) -> None:
        """Close the files that lines are appended to."""
        self._metrics.close()
        self.lineage.close()

    def metrics_size(self) -> int:
        """Bytes in ``metrics.jsonl``."""
        return self._metrics.size


def versions() -> dict[str, str]:
    """Of Skillweave, Python, what it stands on, and the machine."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("skillweave", "torch", "gymnasium", "numpy", "envpool"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
