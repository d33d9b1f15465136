"""Kills at random moments: a run that was killed and resumed ends as one that was not.

A case trains one kind of run until it has been killed ``EACH`` times, at moments drawn over the
whole training's duration. After each kill it does what a user does: it resumes the run, or begins
where there is none. Every run that ends is compared with one without a kill. The moments come
from the seed and the case's number; what they hit depends on the machine.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from functools import partial
from pathlib import Path

from scripts.torture.compare import differences
from scripts.torture.kinds import KINDS, Kind
from scripts.torture.processes import fork, group_is_gone, kill_group, wait
from scripts.torture.report import EQUAL, FILES, HANG, LEFT, LOST, METRICS, WEIGHTS, Outcome

EACH = 5
"""Kills of a case."""
PATIENCE = 60.0
"""Seconds for a training without a kill."""
SORTS = {"weights": WEIGHTS, "metrics": METRICS, "files": FILES}


class Kills:
    """Wholes of every kind, and cases that are compared with them."""

    limit = 4 * PATIENCE

    def __init__(self, folder: Path, seed: int, names: list[str] | None = None) -> None:
        self.folder, self.seed, self.names = folder, seed, names or list(KINDS)
        self.seconds: dict[str, float] = {}
        """How long a whole training of each kind takes."""
        for name in self.names:
            started = time.monotonic()
            train_whole(KINDS[name], self.whole(name))
            self.seconds[name] = time.monotonic() - started

    def prepare(self) -> None:
        """Nothing: a case's trainings have processes of their own."""

    def cases(self, count: int) -> int:
        """Return the number of cases that make this number of kills."""
        return -(-count // EACH)

    def whole(self, name: str) -> Path:
        """Return the uninterrupted run of a kind."""
        return self.folder / "whole" / name

    def case(self, number: int) -> Outcome:
        """Kill and resume until there were enough kills; compare what ends."""
        rng = random.Random(f"kills {self.seed} {number}")
        name = self.names[number % len(self.names)]
        run = self.folder / f"case-{number}"
        shutil.rmtree(run, ignore_errors=True)
        moments: list[str] = []

        def outcome(category: str, said: str = "") -> Outcome:
            return Outcome(category, f"{name}: killed after {', '.join(moments)} s", said)

        while True:
            pid = fork(partial(go_on, KINDS[name], run), log_of(run))
            moment = rng.uniform(0.0, self.seconds[name]) if len(moments) < EACH else PATIENCE
            code = wait(pid, moment)
            if code is None:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                moments.append(f"{moment:.3f}")
                if moment == PATIENCE:
                    return outcome(HANG, "the last resume does not end")
            last = len(moments) == EACH
            if last and not group_is_gone(pid):
                return outcome(LEFT, "the killed training's own processes do not end")
            kill_group(pid)
            if code:
                return outcome(LOST, log_of(run).read_text())
            if code == 0:
                if found := differences(run, self.whole(name)):
                    said = "; ".join(line for lines in found.values() for line in lines)
                    return outcome(SORTS[next(iter(found))], said)
                shutil.rmtree(run)
                log_of(run).unlink()
                if last:
                    return outcome(EQUAL)


def train_whole(kind: Kind, run: Path) -> None:
    """Train in a process of its own, uninterrupted."""
    run.parent.mkdir(parents=True, exist_ok=True)
    if code := wait(fork(partial(go_on, kind, run), log_of(run)), PATIENCE):
        raise SystemExit(f"an uninterrupted training ended with {code}: {log_of(run).read_text()}")


def go_on(kind: Kind, run: Path) -> None:
    """Train, or resume, to the end."""
    kind.go_on(run)


def log_of(run: Path) -> Path:
    """Return where a training's output goes."""
    return run.with_name(f"{run.name}.log")
