"""The run directory, which training writes and everything else reads.

run.json                     the declaration, settings, seeds, versions and stages
metrics.jsonl                a line for every update
lineage.jsonl                a line for every member of every generation, of populations
evaluation.json              the latest evaluation (``training/evaluation_file.py``)
evaluation-sampled.json      the latest evaluation that sampled actions on request
checkpoint.safetensors       the latest checkpoint of the stage in training (and the one before)
calls.safetensors            calls of the skills (``calls/run_log.py``)
cuts.json                    calls that were found in data (``data/timeline.py``)
data.safetensors             steps from elsewhere, from which learners with a replay learn, too
policies/<stage>.safetensors policies of finished stages
states/<name>.safetensors    states of learners that continue in a later stage, until that is done
replay/<skill>.safetensors   steps of a skill that shares its replay, until the last one is done
starts/<name>.safetensors    initial policies from another run, until their learner's stage is done
starts/<stage>.safetensors   observations of a repair's rehearsal, until the repair is done
final/<stage>.safetensors    final states, from which finished stages can train for more steps
policies/<skill>.*           copies of ready policies: .onnx; a torch module's weights
.lock                        locked by the process that trains the run; its number and machine

``manifest`` has the schemas of their contents.
"""

from __future__ import annotations

import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from skillweave._internal.messages import absolute, shown_path
from skillweave._internal.paths import level_of
from skillweave.algorithms.agent_policy import AgentHeader, AgentPolicy, state_from
from skillweave.errors import DeclarationError, RunError
from skillweave.policies.untrusted import shown
from skillweave.runs.checkpoints import Checkpoints
from skillweave.runs.command_words import load_words, resume_words, saved_words
from skillweave.runs.files import (
    TEMPORARY,
    check_no_links,
    check_unchanged,
    check_utf8,
    make_directory,
    read_tensors,
    record_in,
    remove,
    write_json,
    write_tensors,
)
from skillweave.runs.jsonl import JsonLines
from skillweave.runs.lock import NAME as LOCK, Lock
from skillweave.runs.manifest import (
    Checkpoint,
    LineageLine,
    Manifest,
    MetricsLine,
    StageEntry,
    identity,
    read_manifest,
    versions,
)
from skillweave.schema import as_json

S = TypeVar("S")
First = Callable[["RunDirectory"], None]
"""A function that writes the files of a new run before ``run.json``."""


CALLS = "calls.safetensors"
"""The file of logged calls."""
CALLS_LOCK = ".calls.lock"
"""The file that a process locks while it adds calls."""
CUTS = "cuts.json"
"""The file of calls that were found in data."""
DATA = "data.safetensors"
"""The file of steps that were recorded elsewhere."""
FINAL = "final"
"""The folder of final states."""
REPLAY = "replay"
"""The folder of steps of skills that share them."""
LINES = ("metrics_bytes", "lineage_bytes")
"""Fields of headers and of the manifest: sizes of the files of lines."""


LONGEST_NAME = 255
"""The most bytes of a file's name, on nearly all file systems."""
MORE = 14
"""Additional characters of a file's name while it is written."""

FILES = ("run.json", "metrics.jsonl", "lineage.jsonl", DATA, CUTS, LOCK, TEMPORARY)
"""Files that training writes before the first checkpoint."""
FOLDERS = {
    "policies": (TEMPORARY,),
    "starts": ("*.safetensors", TEMPORARY),
    "tensorboard": ("events.out.tfevents.*",),
}
"""Folders of such files. ``policies`` holds copies of ready policies, too."""
RESULTS = (
    "checkpoint*.safetensors",
    CALLS,
    "calls-*.safetensors",
    CALLS_LOCK,
    "evaluation*.json",
    "report.html",
    "film*.gif",
    "hierarchy.gif",
    "agent.gif",
)
"""Files that are added later."""
IN_FOLDERS = ("*.safetensors", TEMPORARY, "events.out.tfevents.*", "*.png", "*.svg")
"""Files in the folders of a run, beside copies of ready policies."""
LEFT = ("wandb",)
"""Folders of a run's trackers; they stay, because they belong to the tracker."""
LOCK_TEXT = re.compile(rb"(\d+ [^\n]*\n)?")
"""The content of a lock file: a process and its machine, or nothing."""


class RunDirectory:
    """A run on disk. ``manifest`` is the content of ``run.json``.

    Its ``path`` is absolute: a program may change its working directory while it trains.
    """

    def __init__(self, path: Path, manifest: Manifest) -> None:
        self.path = absolute(path)
        self.manifest = manifest
        path = self.path
        self._metrics = JsonLines(path / "metrics.jsonl", MetricsLine, self._next_step)
        self.lineage = JsonLines(path / "lineage.jsonl", LineageLine, self._next_step)
        self._checkpoints = Checkpoints(path)
        self._lock: Lock | None = None
        self.reported_absent: set[str] = set()
        """Logged keys of ``info`` whose absence was reported."""
        self.reported_slow = False
        """True after users were informed that evaluations take longer than training."""

    @property
    def num_envs(self) -> int | None:
        """Return the largest number of training environments of all stages; None: no stages."""
        return max((s.num_envs for s in self.manifest.stages), default=None)

    @classmethod
    def create(
        cls,
        path: str | Path,
        manifest: Manifest,
        first: First | None = None,
        *,
        hold: bool = False,
        overwrite: bool = False,
    ) -> RunDirectory:
        """Write a new run, in place of one that has not learnt anything.

        Args:
            first: writes files of the run before ``run.json`` exists.
            hold: keep the run locked, to train it; ``close`` releases it.
            overwrite: replace any run; files in its directory that no run writes stay there.

        Raises:
            RunError: the directory holds a run that has learnt something or that another
                process trains, or other files; or its path is not UTF-8.
        """
        path = absolute(path)
        check_utf8(path)
        _check_file_names(manifest)
        if path.is_file():
            raise RunError(f"{path} exists and is not an empty directory; choose another")
        is_new = not path.exists()
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"could not make {path}: {error.strerror}") from error
        before = cls.open(path) if os.path.lexists(path / "run.json") else None
        if before is not None:
            check_no_links(path)
        if before is None or not overwrite:
            _check_replaceable(path, before)  # before the lock is written there
        lock = Lock(path)
        try:
            if before is not None:
                cls._clear_dead(path, lock, overwrite)
            created = time.strftime("%Y-%m-%dT%H:%M:%S%z")
            run = cls(
                path,
                replace(manifest, versions=versions(), created=created, id=identity(manifest)),
            )
            run._lock = lock
            if first is not None:
                first(run)
            run.save()
        except BaseException:
            if not (path / "run.json").exists():
                remove(path / LOCK)
            lock.release()
            if is_new:
                with suppress(OSError):
                    path.rmdir()
            raise
        if not hold:
            run.close()
        return run

    @classmethod
    def _clear_dead(cls, path: Path, lock: Lock, overwrite: bool) -> None:
        """Remove a run that has not learnt anything, or any run; it is locked."""
        if not lock.exclusive:
            raise RunError(
                f"{path} holds a run, and this system has no locks that show whether a process "
                "uses it. Delete it if none does, or choose another directory"
            )
        run = cls.open(path)
        if not overwrite:  # another process may have trained it until now
            _check_replaceable(path, run)
        _clear_run(run)

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """Return an existing run, to read or to train.

        Raises:
            RunError: the directory holds no run, or it is damaged or newer than this Skillweave.
        """
        path = Path(path)
        if not os.path.lexists(path / "run.json"):
            raise RunError(f"{path} holds no run: {path / 'run.json'} does not exist")
        return cls(path, read_manifest(path))

    def begin(self, *, finished: bool = False) -> None:
        """Lock the run for training, and clean up after a killed process.

        Args:
            finished: also lock a finished run, to train it for longer.

        Raises:
            RunError: another process trains it, it cannot be written, or it holds links.
        """
        if self._lock is not None or (self.finished and not finished):
            return
        check_no_links(self.path)
        self._lock = Lock(self.path)
        try:
            # Another process may have continued it.
            self.manifest = read_manifest(self.path)
            self._clear()
        except BaseException:
            self.close()
            raise

    def _clear(self) -> None:
        """Remove half-written files, and checkpoints that are no longer needed."""
        folders = ("policies", "starts", FINAL)
        for directory in (self.path, *(self.path / name for name in folders)):
            for path in directory.glob(TEMPORARY):
                remove(path)
        self._checkpoints.clear([s.name for s in self.manifest.stages if s.done])

    def save(self) -> None:
        """Write ``run.json``."""
        self.check()
        write_json(self.path / "run.json", self.manifest)

    def check(self) -> None:
        """Raise a RunError where the directory was deleted during the training."""
        if self._lock is not None:
            self._lock.check()

    def stage(self, name: str) -> StageEntry:
        """Return the manifest's entry of a stage: budget, algorithm, status, steps, seconds."""
        for entry in self.manifest.stages:
            if entry.name == name:
                return entry
        names = ", ".join(entry.name for entry in self.manifest.stages)
        raise RunError(f"{self.path} has no stage {shown(name)}; it has: {names}")

    @property
    def finished(self) -> bool:
        """Return whether every stage is done, and compared at its end where it must be."""
        done = all(s.done for s in self.manifest.stages)
        return done and not self.lacks_comparison

    @property
    def has_learnt(self) -> bool:
        """Return whether a new run in its place would lose results of training."""
        done = any(s.done or s.continued for s in self.manifest.stages)
        return done or self._checkpoints.any() or any(self.path.glob(f"{FINAL}/*.safetensors"))

    @property
    def lacks_comparison(self) -> bool:
        """Return whether the comparison that chooses the best hierarchy is still missing."""
        return any(s.kept is None and s.needs_comparison for s in self.manifest.stages)

    def save_checkpoint(self, header: Checkpoint, tensors: Mapping[str, Tensor]) -> None:
        """Write a stage's latest checkpoint; the one before stays beside it.

        Args:
            header: the stage's progress; run and sizes of files are filled in.
            tensors: all that resuming needs: states of learners, environments, replay buffers.
        """
        self.check()
        self._checkpoints.save(tensors, self._filled(header))

    def save_final(self, header: Checkpoint, tensors: Mapping[str, Tensor]) -> None:
        """Write a stage's final state; arguments as in ``save_checkpoint``."""
        self.write(FINAL, header.stage, tensors, self._filled(header), header.stage)

    def _filled(self, header: Checkpoint) -> Checkpoint:
        """Return a header that also has this run's id and the sizes of its files."""
        header = replace(header, run=self.manifest.id)
        self.record_lines(header)
        return header

    def drop_checkpoints(self) -> None:
        """Remove the checkpoints of a stage that ``run.json`` marks as done."""
        self.check()
        self._checkpoints.drop()

    def keep_final(self, stage: str) -> None:
        """Keep the latest checkpoint as the final state, from which the stage can continue."""
        self.check()
        path = self.file(FINAL, stage)
        make_directory(path.parent)
        self._checkpoints.keep(path)

    def make_room(self) -> bool:
        """Remove files that a run can spare on a full disk; return whether any existed.

        These are the checkpoint before the latest, and the final states of finished stages.
        """
        self.check()
        spare = [p for p in self.path.glob(f"{FINAL}/*.safetensors") if p.is_file()]
        for path in spare:
            remove(path)
        return self._checkpoints.drop_previous() or bool(spare)

    def load_checkpoint(self, stage: str) -> tuple[dict[str, Tensor], Checkpoint] | None:
        """Return tensors and header of a stage's latest good checkpoint; None: it has none.

        Without a checkpoint, use the final state of a stage that continues, or whose budget is
        spent.

        Raises:
            RunError: checkpoints of this stage exist, but all are damaged.
        """
        checkpoint = self._checkpoints.load(stage, self.must_be_ours)
        if checkpoint is None and (final := self._final(stage)) is not None:
            entry = self.stage(stage)
            if entry.continued or final[1].steps >= entry.budget:
                checkpoint = final
        return checkpoint

    def _final(self, stage: str) -> tuple[dict[str, Tensor], Checkpoint] | None:
        """Return tensors and header of a stage's final state; None: it has none."""
        path = self.file(FINAL, stage)
        if not path.exists():
            return None
        tensors, found = read_tensors(path, most=None)
        header: Checkpoint = record_in(Checkpoint, found, path)
        if header.stage != stage:
            raise RunError(f"{path} holds the state of stage {shown(header.stage)}")
        self.must_be_ours(header.run, path)
        entry = self.stage(stage)
        if entry.continued[-1:] == [header.steps]:
            # Since then, other stages have added lines and evaluations.
            header.metrics_bytes = header.lineage_bytes = None
            if entry.evaluation_steps is not None:
                header.evaluation_steps = entry.evaluation_steps
        return tensors, header

    def final_tensors(self, stage: str) -> list[str]:
        """Return the names of the tensors of a stage's final state; empty: it has none.

        Raises:
            RunError: the file is damaged, or belongs to another stage or run.
        """
        final = self._final(stage)
        return [] if final is None else list(final[0])

    def save_policies(self, stage: str, policies: Mapping[str, AgentPolicy]) -> None:
        """Write the policies of a finished stage; ``save`` then binds the files to the run."""
        entry = self.stage(stage)
        sums = {}
        for name, policy in policies.items():
            file = _policy_name(stage, name)
            sums[name] = self.write("policies", file, *policy.to_file(), stage)
        if list(sums) == [stage]:
            entry.sha256 = sums[stage]
        else:
            entry.policies = sums

    def file(self, folder: str, name: str) -> Path:
        """Return the path of the file of a stage or a learner in a folder of the run."""
        return self.path / folder / f"{file_name(name)}.safetensors"

    def write(
        self, folder: str, name: str, tensors: Mapping[str, Tensor], header: Any, stage: str
    ) -> str:
        """Write the file of a stage or a learner, with stage and run in its header.

        Args:
            header: a dataclass, or a dict.
            stage: its name.

        Returns:
            Its checksum.
        """
        self.check()
        path = self.file(folder, name)
        make_directory(path.parent)
        header = as_json(header) | {"stage": stage, "run": self.manifest.id}
        return write_tensors(path, tensors, header, make_directories=False)

    def remove(self, folder: str, name: str) -> None:
        """Remove the file of a stage or a learner, and its folder if that is empty then."""
        path = self.file(folder, name)
        remove(path)
        with suppress(OSError):  # it still holds others, or never existed
            path.parent.rmdir()

    def learns_again(self, stage: str, name: str) -> bool:
        """Return whether ``name`` also learns in a later stage."""
        stages = self.manifest.stages
        at = [entry.name for entry in stages].index(stage)
        return any(name in entry.learns for entry in stages[at + 1 :])

    def load_state(self, name: str, like: S) -> S | None:
        """Return the final state of ``name`` in its latest stage; None: none to continue from.

        A population writes none, and a stage whose result was not kept has none to continue from.

        Args:
            name: the learner.
            like: a state with the required shapes and types, a dataclass of tensors.

        Raises:
            RunError: the file is damaged, or belongs to another learner or run.
        """
        path = self.file("states", name)
        if not path.exists():
            return None
        tensors, header = read_tensors(path, most=None)
        if header.get("learns") != name:
            raise RunError(f"{path} does not hold the state of {name!r}")
        self.must_be_ours(header.get("run"), path)
        if self.stage(header.get("stage", "")).undone:
            return None
        return state_from(tensors, like, str(path))

    def sharing_stages(self, like: StageEntry) -> tuple[list[StageEntry], list[StageEntry]]:
        """Return the stages before and after one in which a skill of its level shares its steps."""
        stages = self.manifest.stages
        at = [entry.name for entry in stages].index(like.name)
        before, after = (
            [x for x in part if x.shares and level_of(x.name) == level_of(like.name)]
            for part in (stages[:at], stages[at + 1 :])
        )
        return before, after

    def save_rows(self, entry: StageEntry, rows: Callable[[], Mapping[str, Tensor]]) -> None:
        """Write the rows of a stage's learner, if a later stage begins with them."""
        if entry.shares and any(not x.has_begun for x in self.sharing_stages(entry)[1]):
            self.write(REPLAY, entry.name, rows(), {}, entry.name)

    def load_rows(self, entry: StageEntry) -> Iterator[dict[str, Tensor]]:
        """Yield the rows of earlier stages with which a stage's learner begins; {}: it has none.

        Raises:
            RunError: a file is missing or damaged, or belongs to another run.
        """
        for before in self.sharing_stages(entry)[0] if entry.shares else []:
            path = self.file(REPLAY, before.name)
            if not path.exists():
                raise RunError(
                    f"{path} is not there any more: skill {entry.name!r} would learn from these "
                    f"steps of {before.name!r} (shared_replay); begin a new run"
                )
            tensors, header = read_tensors(path, most=None)
            self.must_be_ours(header.get("run"), path)
            yield tensors

    def save_data(self, tensors: Mapping[str, Tensor]) -> None:
        """Write the steps from which learners of a new run learn, too."""
        header = {"run": self.manifest.id}
        write_tensors(self.path / DATA, tensors, header, make_directories=False)

    def load_data(self) -> dict[str, Tensor] | None:
        """Return the tensors of ``save_data``; None: the run has none.

        Raises:
            RunError: the file is missing or damaged, or belongs to another run.
        """
        if self.manifest.data is None:
            return None
        path = self.path / DATA
        if not path.exists():
            raise RunError(
                f"{path} is not there any more: the run learns from these steps, too; begin a new "
                "run with data=..."
            )
        tensors, header = read_tensors(path, most=None)
        self.must_be_ours(header.get("run"), path)
        return tensors

    def drop_used(self, entry: StageEntry) -> None:
        """Remove the files of a finished stage that no later stage needs.

        They are initial policies, the observations of a rehearsal, steps that are shared, and final
        states of learners.
        """
        before, after = self.sharing_stages(entry) if entry.shares else ([], [])
        if all(later.done for later in after):
            for earlier in before:
                self.remove(REPLAY, earlier.name)
        for name in entry.learns:
            if not self.learns_again(entry.name, name):
                self.remove("states", name)
        if entry.kept is not None or not entry.needs_comparison:
            for name in entry.starts:
                self.remove("starts", name)
        if entry.repair is not None and entry.repair.rehearsal is not None:
            self.remove("starts", entry.name)

    def must_be_ours(self, run: str | None, path: Path) -> None:
        """Raise a RunError where ``run``, which a file's header names, is another run."""
        if run != self.manifest.id:
            raise RunError(f"{path} belongs to another run")

    def load_policies(self, stage: str) -> dict[str, AgentPolicy]:
        """Return a finished stage's policies by name; raise the errors of ``load_policy``."""
        entry = self.stage(stage)
        names = entry.policies or [stage]
        return {name: self.load_policy(stage, name) for name in names}

    def load_policy(self, stage: str, name: str | None = None) -> AgentPolicy:
        """Return the policy of a finished stage, or of one of its learners.

        Raises:
            RunError: the stage is not finished, or its file is damaged.
        """
        entry = self.stage(stage)
        if not entry.done:
            raise RunError(
                f"{self.path} is not finished: its stage {stage!r} is not done "
                f"({saved_words(self)}). Continue it: {resume_words(self)}"
            )
        path = self.policy_path(stage, name)
        tensors, header = read_tensors(path)
        if header.get("kind") != "agent":
            raise RunError(f"{path} holds no agent's policy")
        of: AgentHeader = record_in(AgentHeader, header, path)
        if of.stage != stage:
            raise RunError(f"{path} holds the policy of stage {shown(of.stage)}")
        self.must_be_ours(of.run, path)
        check_unchanged(path, header, entry.policies.get(name or "", entry.sha256))
        return AgentPolicy.from_file(tensors, of, str(path))

    def policy_path(self, stage: str, name: str | None = None) -> Path:
        """Return the path of a stage's policy, or of one of its learners."""
        return self.file("policies", _policy_name(stage, name))

    def log(self, record: dict[str, Any]) -> None:
        """Append a line to ``metrics.jsonl``."""
        self.check()
        self._metrics.append([record])

    def record_lines(self, entry: StageEntry | Checkpoint) -> None:
        """Record the sizes of ``metrics.jsonl`` and ``lineage.jsonl``, for ``rewind``."""
        entry.metrics_bytes, entry.lineage_bytes = self._metrics.size, self.lineage.size

    def rewind(self, at: Mapping[str, int]) -> list[str]:
        """Drop the lines after the sizes of ``record_lines``: training writes them again.

        Args:
            at: sizes that ``record_lines`` recorded; a missing size drops nothing.

        Returns:
            The files that were removed or shortened and lack lines; each is returned once.
        """
        lacking = []
        for key, lines in zip(LINES, (self._metrics, self.lineage), strict=True):
            entries = [s for s in self.manifest.stages if getattr(s, key) is not None]
            least = max([at.get(key, 0), *(getattr(entry, key) for entry in entries)])
            lines.rewind(at.get(key))
            if lines.size < least:
                lacking.append(lines.path.name)
                for entry in entries:
                    setattr(entry, key, min(getattr(entry, key), lines.size))
        return lacking

    def _next_step(self) -> str:
        return resume_words(self)

    def metrics(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of ``metrics.jsonl`` except a half-written last line."""
        return self._metrics.read()

    def close(self) -> None:
        """Close the files of lines, and release the lock."""
        self._metrics.close()
        self.lineage.close()
        if self._lock is not None:
            self._lock.release()
            self._lock = None


# Names of files


def _check_file_names(manifest: Manifest) -> None:
    """Raise a DeclarationError where the name of a policy's file would be too long."""
    for entry in manifest.stages:
        for name in (entry.name, *entry.learns):
            file = f"{_policy_name(entry.name, name)}.safetensors"
            if len(file) + MORE > LONGEST_NAME:
                raise DeclarationError(
                    f"the weights of {shown(name, 100)} would be in a file whose name has "
                    f"{len(file)} letters, and file systems take {LONGEST_NAME - MORE}; give "
                    "skills on the way to it shorter names"
                )


def _policy_name(stage: str, name: str | None) -> str:
    """Return the name of a stage's policy, or of one of its learners."""
    return stage if name in (None, stage) else f"{stage}.{name}"


def file_name(path: str) -> str:
    """Return the file name of a path in the hierarchy: ``inner.skill`` for ``inner/skill``."""
    return path.replace("/", ".")


# Directories that a new run may take: an empty one, or one whose run has not learnt anything


def _check_replaceable(path: Path, run: RunDirectory | None) -> None:
    """Raise a RunError where a new run would replace results, or files that training did not write.

    Args:
        run: the run in it; None: it holds no run.
    """
    replace = "choose another directory; or replace it: overwrite=True, --overwrite"
    if run is not None and run.finished:
        raise RunError(
            f"{shown_path(run.path)} holds a finished run. Load it: {load_words(run)}; or give "
            f"more steps and continue it: {resume_words(run)}; or {replace}"
        )
    if run is not None and run.has_learnt:
        raise RunError(
            f"{shown_path(run.path)} holds an unfinished run, {saved_words(run)}. Continue it: "
            f"{resume_words(run)}; or {replace}"
        )
    if not (path / "run.json").is_file():
        lock = path / LOCK
        is_lock = lock.is_file() and not lock.is_symlink() and lock.stat().st_size < 300
        if any(path.iterdir()) and not (is_lock and LOCK_TEXT.fullmatch(lock.read_bytes())):
            raise RunError(f"{path} exists and is not an empty directory; choose another")
    for foreign in _foreign(path, () if run is None else _copies(run)):
        raise RunError(
            f"{path} holds {foreign.relative_to(path)}, which is no file of a run that has just "
            "started, so nothing there is replaced; choose another directory"
        )


def _copies(run: RunDirectory) -> tuple[str, ...]:
    """Return patterns of the files of ready policies in a run."""
    return tuple(f"{file_name(s.name)}.*" for s in run.manifest.skills)


def _foreign(path: Path, copies: tuple[str, ...]) -> Iterator[Path]:
    """Yield files that a new run does not write; ``copies`` are names of ready policies' files."""
    for entry in path.iterdir():
        mode = entry.lstat().st_mode
        if stat.S_ISREG(mode):
            if not _fits(entry, FILES):
                yield entry
        elif not stat.S_ISDIR(mode) or entry.name not in (*FOLDERS, *LEFT):
            yield entry
        elif entry.name in FOLDERS:
            patterns = FOLDERS[entry.name] + (copies if entry.name == "policies" else ())
            for inner in entry.rglob("*"):
                mode = inner.lstat().st_mode
                plain = stat.S_ISREG(mode) and _fits(inner, patterns)
                if not plain and not stat.S_ISDIR(mode):
                    yield inner


def _clear_run(run: RunDirectory) -> None:
    """Remove the files of a run; others stay.

    Raises:
        RunError: a file cannot be removed.
    """
    remove(run.path / "run.json")  # first: without it, the other files have no meaning
    for entry in list(run.path.iterdir()):
        if entry.name in (*FOLDERS, "states", REPLAY, FINAL, "plots") and entry.is_dir():
            for inner in (*sorted(entry.rglob("*"), reverse=True), entry):
                if inner.is_file() and _fits(inner, (*IN_FOLDERS, *_copies(run))):
                    remove(inner)
                with suppress(OSError):  # other files, and folders that hold some, stay
                    inner.rmdir()
        elif entry.name != LOCK and entry.is_file() and _fits(entry, (*FILES, *RESULTS)):
            remove(entry)


def _fits(path: Path, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch(path.name, pattern) for pattern in patterns)
