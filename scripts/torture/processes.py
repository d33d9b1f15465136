"""Cases in forked processes: a case that hangs or crashes ends its process and no other.

The process that forks has imported everything and has no threads, so a child starts at once.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import resource
import select
import signal
import struct
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from scripts.torture.report import CRASH, HANG, TRACEBACK, Outcome

Case = Callable[[int], Outcome]
_SIZE = struct.Struct("<I")
_notes: list[int] = []
"""Where ``note`` writes to, in a process that does cases."""


def note(what: str) -> None:
    """Note the next action of the running case, for the report of one that never ends."""
    for pipe in _notes:
        _send(pipe, what)


def fork(job: Callable[[], int | None], log: Path | None = None) -> int:
    """Start ``job`` in a child, whose exit code it returns; the child's process id.

    The child leads a group of its own, and is killed when its parent dies. An exception is printed
    and gives code 70. ``log``: a file for all that is printed.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    if pid := os.fork():
        return pid
    code = 70
    try:
        os.setsid()
        _die_with(parent)
        if log is not None:
            to = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(to, 1)
            os.dup2(to, 2)
            sys.stdout = sys.stderr = os.fdopen(to, "a", buffering=1)
        code = job() or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def wait(pid: int, seconds: float) -> int | None:
    """Return the exit code of a child, negative for a signal; None: it is still running."""
    end = time.monotonic() + seconds
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() >= end:
            return None
        time.sleep(0.001)


def kill_group(pid: int) -> None:
    """Kill what is left of a dead child's group."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)


def group_is_gone(pid: int, seconds: float = 10.0) -> bool:
    """Return whether all of a dead child's group ends by itself."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            os.killpg(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def limit_memory(more: int) -> None:
    """Let this process take ``more`` bytes than it has, and not another one."""
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + more, now + more))


def run_cases(
    case: Case, numbers: Iterable[int], *, jobs: int, limit: float, prepare: Callable[[], Any]
) -> Iterator[tuple[int, Outcome]]:
    """Every case's outcome, as they come, from ``jobs`` processes side by side.

    Args:
        case: does one case. An exception of it is a TRACEBACK, its process's end a CRASH.
        limit: seconds; a case that takes longer is a HANG.
        prepare: called once in each process, before its first case.
    """
    waiting = iter(numbers)
    workers: list[_Worker] = []
    try:
        for number in waiting:
            workers.append(_Worker(case, prepare))
            workers[-1].give(number)
            if len(workers) == jobs:
                break
        while workers:
            select.select([w.answers for w in workers], [], [], 0.1)
            for place, worker in reversed(list(enumerate(workers))):
                outcome = worker.outcome(limit)
                if outcome is None:
                    continue
                yield worker.number, outcome
                following = next(waiting, None)
                if following is None:
                    worker.close()
                    del workers[place]
                    continue
                if worker.dead:
                    workers[place] = worker = _Worker(case, prepare)
                worker.give(following)
    finally:
        for worker in workers:
            worker.close()


class _Worker:
    """A process that does one case after another."""

    def __init__(self, case: Case, prepare: Callable[[], Any]) -> None:
        take, self._tasks = os.pipe()
        self.answers, give = os.pipe()
        self.dead, self.number, self._since, self._what = False, -1, 0.0, ""

        def work() -> None:
            os.close(self._tasks)
            os.close(self.answers)
            _notes[:] = [give]
            prepare()
            while task := os.read(take, _SIZE.size):
                _send(give, _outcome(case, _SIZE.unpack(task)[0]))

        self._pid = fork(work)
        os.close(take)
        os.close(give)

    def give(self, number: int) -> None:
        self.number, self._since, self._what = number, time.monotonic(), ""
        os.write(self._tasks, _SIZE.pack(number))

    def outcome(self, limit: float) -> Outcome | None:
        """Return what came of its case; None: nothing yet."""
        while select.select([self.answers], [], [], 0)[0]:
            if not (size := self._read(_SIZE.size)):
                return self._crash(self._bury())
            found = pickle.loads(self._read(_SIZE.unpack(size)[0]))
            if isinstance(found, Outcome):
                return found
            self._what = found
        if (code := wait(self._pid, 0.0)) is not None:  # what it left running holds its pipe open
            return self._crash(self._bury(code))
        if time.monotonic() < self._since + limit:
            return None
        self._bury()
        said = f"it took more than {limit:g} s, and no exception ended it"
        return Outcome(HANG, self._what, said)

    def close(self) -> None:
        if not self.dead:
            self._bury()

    def _crash(self, code: int) -> Outcome:
        name = signal.Signals(-code).name if code < 0 else f"code {code}"
        return Outcome(CRASH, self._what, f"its process ended: {name}")

    def _bury(self, code: int | None = None) -> int:
        self.dead = True
        os.close(self._tasks)
        os.close(self.answers)
        if code is None and (code := wait(self._pid, 0.5)) is None:
            os.kill(self._pid, signal.SIGKILL)
            code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        kill_group(self._pid)
        return code

    def _read(self, size: int) -> bytes:
        data = b""
        while len(data) < size and (more := os.read(self.answers, size - len(data))):
            data += more
        return data


def _outcome(case: Case, number: int) -> Outcome:
    try:
        return case(number)
    except Exception:
        return Outcome(TRACEBACK, "the harness itself", traceback.format_exc())


def _send(pipe: int, message: str | Outcome) -> None:
    data = pickle.dumps(message)
    data = _SIZE.pack(len(data)) + data
    while data:
        data = data[os.write(pipe, data) :]


def _die_with(parent: int) -> None:
    """Ask Linux to kill this process when its parent dies; elsewhere nothing happens."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(70)
