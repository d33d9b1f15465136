"""A bad disk: every write, sync, rename and opening of a training fails, one after another.

A case is one operation of one kind of training, in order, with one fault: no space, an error of
the device, or the process's death at this very moment. The disk is bad once, or stays bad. The
training must end with a sentence (or finish all the same); what was saved before must still be
there; and resumed on a good disk, the run must end as one that met no fault.
"""

from __future__ import annotations

import builtins
import errno
import io
import json
import os
import random
import shutil
import signal
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from scripts.torture.compare import differences
from scripts.torture.kills import PATIENCE, SORTS, go_on, log_of, train_whole
from scripts.torture.kinds import KINDS, Kind
from scripts.torture.processes import fork, kill_group, wait
from scripts.torture.report import EQUAL, FINISHED, HANG, LOST, TRACEBACK, Outcome
from skillweave.errors import SkillweaveError
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors

NAMES = (
    "skills and selector",
    "replay of continuous actions",
    "population, replay",
    "start from another run",
)
"""Together they write every file that a training writes."""
FAULTS = ("no space, once", "no space from here on", "an error, once", "death")
SENTENCE = 3
"""The exit code of a training that ended with a sentence."""


class Disk:
    """Every kind's operations, and cases in which one of them fails."""

    limit = 4 * PATIENCE

    def __init__(self, folder: Path, seed: int, names: Sequence[str] = NAMES) -> None:
        self.folder, self.seed = folder, seed
        self.faults: list[tuple[str, int, str, str]] = []
        """(kind, number of the operation, what it is, fault)"""
        for name in names:
            train_whole(KINDS[name], self.whole(name))
            run = folder / "counted"
            pid = fork(partial(train_badly, KINDS[name], run, None, ""), log_of(run))
            if code := wait(pid, PATIENCE):
                raise SystemExit(f"counting ended with {code}: {log_of(run).read_text()}")
            operations = noted(run).read_text().splitlines()
            shutil.rmtree(run)
            self.faults += [
                (name, number, operation, fault)
                for number, operation in enumerate(operations)
                for fault in FAULTS
                if can_meet(operation, fault)
            ]
        random.Random(f"disk {seed}").shuffle(self.faults)

    def whole(self, name: str) -> Path:
        """Return the run of a kind that met no fault."""
        return self.folder / "whole" / name

    def prepare(self) -> None:
        """Nothing: a case's trainings have processes of their own."""

    def cases(self, count: int) -> int:
        """Return all faults, or a number of them."""
        return min(count, len(self.faults))

    def case(self, number: int) -> Outcome:
        """Train with one fault, resume without, compare."""
        name, operation, what, fault = self.faults[number]
        run = self.folder / f"case-{number}"
        shutil.rmtree(run, ignore_errors=True)
        outcome = partial(Outcome, what=f"{fault}, {what}: operation {operation} of {name}")
        log = log_of(run)
        pid = fork(partial(train_badly, KINDS[name], run, operation, fault), log)
        code = wait(pid, PATIENCE)
        kill_group(pid)
        if code is None:
            return outcome(HANG, said="the training with the fault does not end")
        if code not in (0, SENTENCE, -signal.SIGKILL):
            return outcome(TRACEBACK, said=log.read_text())
        before = tuple(json.loads(noted(run).read_text()))
        if (after := position(run)) < before:
            return outcome(LOST, said=f"saved before {before}, after {after}")
        log.write_text("")
        pid = fork(partial(go_on, KINDS[name], run), log)
        if (ended := wait(pid, PATIENCE)) != 0:
            kill_group(pid)
            return outcome(LOST, said=f"the resume ended with {ended}: {log.read_text()}")
        if found := differences(run, self.whole(name)):
            said = "; ".join(line for lines in found.values() for line in lines)
            return outcome(SORTS[next(iter(found))], said=said)
        shutil.rmtree(run)
        return outcome(FINISHED if code == 0 else EQUAL)


def can_meet(operation: str, fault: str) -> bool:
    """Return whether the fault can come at this operation: some need no space."""
    return not ("no space" in fault and operation.startswith(("chmod", "truncate", "unlink")))


def train_badly(kind: Kind, run: Path, operation: int | None, fault: str) -> int:
    """Train; the operation of this number meets a fault. None: count, and note all of them."""
    seen: list[str] = []

    def met(what: str, path: Any) -> bool:
        """Return whether an operation fails; may not come back."""
        if isinstance(path, int) or not Path(os.fspath(path)).is_relative_to(run):
            return False
        number = len(seen)
        name = Path(os.path.relpath(path, run)).name.lstrip(".").split(".")[0]
        seen.append(f"{what} {name or 'the run itself'}")
        if operation is None or number < operation or not can_meet(what, fault):
            return False
        if number == operation:
            noted(run).write_text(json.dumps(position(run)))
            if fault == "death":
                os.kill(os.getpid(), signal.SIGKILL)
        return number == operation or "from here on" in fault

    spoil(met, errno.EIO if "error" in fault else errno.ENOSPC)
    try:
        kind.train(run)
    except SkillweaveError as error:
        print(f"error: {error}")
        return SENTENCE
    if operation is None:
        noted(run).write_text("\n".join(seen))
    return 0


def spoil(met: Callable[[str, Any], bool], number: int) -> None:
    """Call ``met`` before each further operation on a file, and fail where it returns True."""

    def fail(path: Any) -> None:
        raise OSError(number, os.strerror(number), str(path))

    def checked(name: str) -> Any:
        plain = getattr(os, name)

        def operation(path: Any, *arguments: Any, **how: Any) -> Any:
            if met(name, _path_of(path)):
                fail(path)
            return plain(path, *arguments, **how)

        return operation

    for name in ("open", "mkdir", "replace", "rename", "truncate", "chmod", "fsync", "unlink"):
        setattr(os, name, checked(name))
    plain_open = io.open

    def opened(path: Any, mode: str = "r", *arguments: Any, **how: Any) -> Any:
        if not set(mode) & set("wax+"):
            return plain_open(path, mode, *arguments, **how)
        if not isinstance(path, int) and met("open", path):
            fail(path)
        return _File(plain_open(path, mode, *arguments, **how), _path_of(path), met, fail)

    io.open = builtins.open = opened  # type: ignore[assignment]


class _File:
    """A file that is written to; a write that fails has written half, as on a full disk."""

    def __init__(self, file: Any, path: Any, met: Any, fail: Any) -> None:
        self._file, self._path, self._met, self._fail = file, path, met, fail

    def write(self, data: Any) -> Any:
        if self._met("write", self._path):
            self._file.write(data[: len(data) // 2])
            self._file.flush()
            self._fail(self._path)
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *_: Any) -> None:
        self._file.close()


def _path_of(path: Any) -> Any:
    """Return the path of an open file, or the path itself."""
    return os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else path


def position(run: Path) -> tuple[int, int, int]:
    """Return how much of a run is saved: whether there is one, stages that are done, updates."""
    if not (run / "run.json").exists():
        return 0, 0, 0
    found = RunDirectory.open(run)
    done = [p.name for p in found.manifest.stages if p.done]
    for name in done:
        found.load_policies(name)
    for file in ("checkpoint", "checkpoint.previous"):
        try:
            header = read_tensors(run / f"{file}.safetensors")[1]
        except SkillweaveError:
            continue
        if header["stage"] not in done:
            return 1, len(done), header["update"]
    return 1, len(done), 0


def noted(run: Path) -> Path:
    """Return where a training notes what it met."""
    return run.parent / f"noted-{run.name}.json"
