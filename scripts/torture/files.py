"""Mutated runs and files: each is refused with a sentence, or plays exactly as the original.

A case copies one sample, changes one file of it (see ``mutations``), and does what a user does
(see ``samples``), watched by the guard, a clock and a limit of memory.
"""

from __future__ import annotations

import os
import pickle
import random
import re
import shutil
import signal
import sys
import tempfile
import traceback
import types
import warnings
from functools import partial
from pathlib import Path
from typing import Any

from scripts.torture.guard import GUARD
from scripts.torture.hostile_pickles import MARK
from scripts.torture.mutations import Change, change
from scripts.torture.processes import fork, limit_memory, note, wait
from scripts.torture.report import (
    ASKED,
    CHANGED,
    CODE,
    EQUAL,
    HANG,
    LONG,
    MEMORY,
    NAMELESS,
    OTHERWISE,
    REFUSED,
    TRACEBACK,
    Outcome,
)
from scripts.torture.samples import SAMPLES, Play, Sample
from skillweave.compat import pickles
from skillweave.errors import SkillweaveError

SECONDS = 4
"""Of the processor's time, what a case may take; then an exception ends it."""
MORE_MEMORY = 1 << 31
"""Bytes that a case may reserve."""
MUCH_MEMORY = 400 << 20
"""Bytes that a case may really take: samples are small."""
LONGEST = 1_000
"""Characters of a message that people read to its end."""
EVIL = "from scripts.torture.guard import GUARD\nGUARD.hit('evil.py was imported')\n"


class Slow(BaseException):
    """A case took too long."""


class Files:
    """Samples, and cases that change them."""

    limit = 20.0

    def __init__(self, folder: Path, seed: int, names: list[str] | None = None) -> None:
        self.folder, self.seed, self.names = folder, seed, names or list(SAMPLES)
        self.expected: dict[str, Play] = {}
        self.warm: set[str] = set()
        for name in self.names:
            for code in (make_original, play_original):
                pid = fork(partial(code, SAMPLES[name], self.original(name)), folder / "log")
                if wait(pid, 120.0):
                    raise SystemExit(f"sample {name!r}: {(folder / 'log').read_text()}")
            self.expected[name] = pickle.loads(played(self.original(name)).read_bytes())
        (folder / "evil").mkdir()
        (folder / "evil" / "evil.py").write_text(EVIL)

    def original(self, name: str) -> Path:
        """Return where a sample lies."""
        return self.folder / "samples" / name.replace(" ", "-")

    def cases(self, count: int) -> int:
        """Return the cases: each is one mutated run or file."""
        return count

    def prepare(self) -> None:
        """Prepare a process before its first case."""
        sys.path.insert(0, str(self.folder / "evil"))
        sys.dont_write_bytecode = True
        warnings.simplefilter("ignore")
        signal.signal(signal.SIGPROF, _too_slow)
        limit_memory(MORE_MEMORY)

    def copy(self, name: str, what: str) -> Path:
        """Return a sample's copy for one case."""
        target = self.folder / f"{what}-{os.getpid()}"
        _remove(target)
        shutil.copytree(self.original(name), target)
        return target

    def case(self, number: int) -> Outcome:
        """Copy, change, use."""
        rng = random.Random(f"files {self.seed} {number}")
        (name,) = rng.choices(self.names, [SAMPLES[n].share for n in self.names])
        sample = SAMPLES[name]
        if name not in self.warm:  # what is lazy is done once, unwatched
            sample.use(self.copy(name, "warm-up"), "")
            self.warm.add(name)
        folder = self.copy(name, "case")
        changed = change(rng, folder)
        what = f"{changed.kind}: {changed.details} in {changed.file} of {name}"
        note(what)
        outcome = judge(sample, folder, changed, self.expected[name])
        if "hostile" in changed.kind and not outcome.bad:
            outcome = self.afterwards(name, outcome)
        return Outcome(outcome.category, what, outcome.said)

    def afterwards(self, name: str, outcome: Outcome) -> Outcome:
        """Return the outcome, unless the pickle has changed the reader itself."""
        if touched := changed_functions():
            return Outcome(CHANGED, said=f"functions of the reader were changed: {touched}")
        if SAMPLES[name].use(self.copy(name, "again"), "") != self.expected[name]:
            return Outcome(OTHERWISE, said="the original is read otherwise after this pickle")
        return outcome


def judge(sample: Sample, folder: Path, changed: Change, expected: Play) -> Outcome:
    """Use a changed sample, and say what came of it."""
    category, said = "", ""
    tempfile.tempdir = str(folder)
    forget_peak()
    before = resident("VmRSS")
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with GUARD.armed(folder):
            found = sample.use(folder, changed.file)
        category = EQUAL if found == expected else ASKED if changed.asks else OTHERWISE
        if category == OTHERWISE:
            said = "; ".join(k for k in found if found[k] != expected.get(k))
    except SkillweaveError as error:
        said = str(error)
        category = REFUSED if str(folder) in said else NAMELESS
        category = LONG if len(said) > LONGEST else category
    except Slow:
        category = ASKED if changed.asks else HANG
        said = traceback.format_exc()
    except BaseException:  # also what is no Exception, such as SystemExit
        category, said = TRACEBACK, shortened(traceback.format_exc())
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        tempfile.tempdir = None
    if GUARD.hits or (folder / MARK).exists() or Path(MARK).exists():
        return Outcome(CODE, said="; ".join(GUARD.hits) or f"{MARK} was made")
    taken = resident("VmHWM") - before
    if taken > MUCH_MEMORY and category != HANG:
        return Outcome(MEMORY, said=f"took {taken >> 20} MB, then: {category} {said[:300]}")
    return Outcome(category, said=said)


def functions() -> dict[str, types.FunctionType]:
    """Return what the reader of pickles is made of."""
    return {n: f for n, f in vars(pickles).items() if isinstance(f, types.FunctionType)}


DEFAULTS = {name: function.__defaults__ for name, function in functions().items()}


def changed_functions() -> list[str]:
    """Mend and return functions of the reader with attributes or defaults of a pickle's."""
    found = []
    for name, function in functions().items():
        if vars(function) or function.__defaults__ != DEFAULTS.get(name):
            found.append(name)
            vars(function).clear()
            function.__defaults__ = DEFAULTS.get(name)
    return found


def make_original(sample: Sample, folder: Path) -> None:
    """Make a sample."""
    folder.mkdir(parents=True)
    sample.make(folder)


def play_original(sample: Sample, folder: Path) -> None:
    """Write down how a sample plays; it must do so twice."""
    plays = []
    for number in range(2):
        copy = folder.with_name(f"{folder.name}-{number}")
        shutil.copytree(folder, copy)
        plays.append(sample.use(copy, ""))
        shutil.rmtree(copy)
    if plays[0] != plays[1]:
        raise SystemExit("it does not play twice alike")
    played(folder).write_bytes(pickle.dumps(plays[0]))


def played(folder: Path) -> Path:
    """Return the file that holds a sample's plays."""
    return folder.with_suffix(".plays")


def forget_peak() -> None:
    """Let Linux measure this process's most memory from now on."""
    Path("/proc/self/clear_refs").write_text("5")


def resident(which: str) -> int:
    """Return bytes of memory that this process has (VmRSS), or had at most (VmHWM)."""
    found = re.search(rf"{which}:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) * 1024 if found else 0


def shortened(text: str) -> str:
    """Return a traceback without the repetitions of a deep recursion, and with short lines."""
    lines = [line[:400] for line in text.splitlines()]
    return "\n".join(lines if len(lines) < 80 else [*lines[:40], "...", *lines[-30:]])


def _too_slow(*_: Any) -> None:
    raise Slow


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)
