"""Collectors in processes of their own: environments step and policies act there.

Each request is for a whole rollout (``channel``). A process that dies is started again
(``workers``). A process whose parent dies ends itself (``worker_process``).
"""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from contextvars import copy_context
from multiprocessing.connection import wait
from time import monotonic
from typing import Any

from skillweave._internal.messages import error_text
from skillweave._internal.notices import notice
from skillweave.errors import TrainingError, make_error
from skillweave.workers.channel import Channel, channels
from skillweave.workers.host import Worker, WorkerFactory, WorkerLost
from skillweave.workers.shipping import packed, unpacked
from skillweave.workers.start_methods import GUARD
from skillweave.workers.worker_process import TorchModes, end_group, work

PATIENCE = 1.0
"""Seconds that workers have to end by themselves when they are closed."""
DYING = 10.0
"""Seconds that a busy system has to end a process that was killed, or that closed its pipe."""
SILENCE = 60.0
"""Seconds without an answer until a notice; they double with each notice."""


class _Maker:
    """A function that makes a collector; it is sent with the user's code to unforked processes."""

    def __init__(self, make: WorkerFactory) -> None:
        self.make = make

    def __getstate__(self) -> bytes:
        return packed(self.make, "what a worker's collector is made of")

    def __setstate__(self, data: bytes) -> None:
        self.make = unpacked(data)


class ProcessWorker(Worker):
    """A collector in a process.

    Args:
        make: makes the collector.
        each: number of its environments.
        number: the worker's number.
    """

    def __init__(self, make: WorkerFactory, each: int, number: int) -> None:
        self._make = make
        self._each = each
        self._number = number
        self._context: Any = mp.get_context()
        self._modes = TorchModes.here()
        self.process: Any = None
        self.channel: Channel | None = None
        self._answered = False  # this process, at least once
        self._asked, self._since = "", 0.0
        self._silence = SILENCE
        self._told = False

    def begin(self) -> None:
        """Start the process, which makes the collector.

        Raises:
            TrainingError: the system does not let it start.
        """
        try:
            _in_starter(self._start)
        except OSError as error:
            raise TrainingError(
                f"{self.who} could not be started: {error_text(error)}. The system limits "
                "descriptors (ulimit -n), processes (ulimit -u) and memory: raise the limit, or "
                "have fewer processes, EnvSpec(workers=...)"
            ) from error
        self._answered = False
        self._expect("making its environments")

    def _start(self) -> None:
        """Start the process; no other is started meanwhile, which would keep ends of its pipe."""
        self.channel, theirs = channels(self._context)
        serves = self._context.get_start_method() == "forkserver"
        self.process = self._context.Process(
            target=work,
            args=(
                self._number, _Maker(self._make), self._each, theirs, self.channel,
                None if serves else os.getpid(), self._modes,
            ),
            name=f"collector-{self._number}",
            daemon=True,
        )  # fmt: skip
        try:
            self.process.start()
        finally:
            theirs.close()

    def send(self, what: str, task: Any) -> None:
        """Send a task to the process.

        Raises:
            WorkerLost: the process has ended.
            TrainingError: the process runs, but the task cannot be sent.
        """
        assert self.channel is not None
        self._expect(_described(what, task))
        try:
            self.channel.send((what, task))
        except (BrokenPipeError, ConnectionResetError):
            raise WorkerLost(self._end()) from None
        except Exception as error:
            raise TrainingError(
                f"{self.who}: its next task ({self._asked}) could not be sent: {error_text(error)}"
            ) from error

    def receive(self) -> Any:
        """Return the process's next answer; arrays of rows are valid until the next task.

        Raises:
            WorkerLost: the process has ended.
            SkillweaveError: the request failed there; the kind is the kind of that error.
        """
        assert self.channel is not None
        pipe = self.channel.pipe
        try:
            while not pipe.poll():
                # A pipe whose other end is closed is ready too; another process may hold that end.
                until = None if self._told else self._since + self._silence - monotonic()
                wait([pipe, self.process.sentinel], until)
                if not pipe.poll() and not self.process.is_alive():
                    raise EOFError
                self._tell_silence()
            error, answer, notices = self.channel.receive(views=True)
        except (EOFError, OSError):
            raise WorkerLost(self._end()) from None
        self._answered = True
        for text in notices:
            notice(text)
        if error is not None:
            raise make_error(*error)
        return answer

    def release(self) -> None:
        """Let the process close its environments; end it if it does not."""
        self.release_all([self])

    def release_all(self, workers: Sequence[ProcessWorker]) -> None:
        """Let workers close their environments, all at once; end those that do not."""
        for worker in workers:
            if worker.channel is not None:
                with suppress(OSError):
                    worker.channel.send(("close", None))
        for end, seconds in (("join", PATIENCE), ("terminate", PATIENCE / 2), ("kill", DYING)):
            until = monotonic() + seconds
            for worker in workers:
                process = worker.process
                if process is None or process.pid is None:
                    continue
                if end != "join" and process.is_alive():
                    getattr(process, end)()
                process.join(max(0.0, until - monotonic()))
        for worker in workers:
            if worker.process is not None and worker.process.exitcode:
                end_group(worker.process.pid)  # it was killed before its environments were closed
        for worker in workers:
            _tell_last(worker)
            worker.forget()

    def forget(self) -> None:
        """Close its pipe and release its shared memory."""
        if self.channel is not None:
            self.channel.close()
            self.channel = None

    def _expect(self, asked: str) -> None:
        self._asked = asked
        self._since = monotonic()
        self._told = False

    def _tell_silence(self) -> None:
        """Give a notice once if there is no answer for a long time."""
        if self._told or monotonic() - self._since < self._silence:
            return
        notice(
            f"{self.who} (process {self.process.pid}) has not answered for {self._silence:.0f} s; "
            f"it is {self._asked}. If its environments are not as slow as that, one of them hangs: "
            f"py-spy dump --pid {self.process.pid} shows where. Ctrl-C stops the run"
        )
        self._silence = 2 * self._silence
        self._told = True

    def _end(self) -> str:
        """Return words on the end of its process."""
        self.process.join(DYING)
        code = self.process.exitcode
        if code is not None:
            end_group(self.process.pid)
        if code is None:
            return f"closed its connection while it was {self._asked}"
        if code < 0:
            return f"{_by_signal(-code)} while it was {self._asked}"
        died = f"died with exit code {code} while it was {self._asked}"
        if code and not self._answered and self._context.get_start_method() != "fork":
            return (
                f"{died} (its error stands above). A process that is started by "
                f"{self._context.get_start_method()!r} imports the program: {GUARD}"
            )
        return f"{died}, as if something there had called sys.exit or os._exit"


def _by_signal(number: int) -> str:
    """Return words for a process that a signal has ended."""
    try:
        name = signal.Signals(number).name
    except ValueError:
        name = "?"
    how = f"died by signal {number} ({name}, {signal.strsignal(number)})"
    if number == signal.SIGKILL:
        how += ", perhaps because memory ran out,"
    return how


def _described(what: str, task: Any) -> str:
    """Return words on a worker's task, to follow "it is"."""
    if what == "collect":
        return f"making {task.rows:,} steps in each of its environments"
    return {
        "start": "resetting or checking its environments",
        "finish": "checking its environments after training",
        "state": "sending the state of its environments",
        "restore": "playing its open episodes again",
        "train": "training its members of the population",
        "fitness": "measuring its members' fitness",
    }.get(what, what)


_start_lock = threading.Lock()


def _in_starter(start: Callable[[], None]) -> None:
    """Start a worker process from a new thread, one at a time.

    A forked process continues as a copy of the thread that forks. If that thread has computed with
    several OpenMP threads, the copy still counts on them, and waits forever where the user's code
    lets torch use several.
    """
    errors: list[BaseException] = []

    def run() -> None:
        """Start the worker process in this thread; keep an error for the caller."""
        try:
            with _start_lock:
                start()
        except BaseException as error:
            errors.append(error)

    # No pool of threads: those start no work once the main thread has ended.
    thread = threading.Thread(target=copy_context().run, args=(run,), name="starter")
    thread.start()
    thread.join()
    if errors:
        raise errors[0]


def _forget_start() -> None:
    """Let a forked process start others: the lock it has copied is held."""
    global _start_lock
    _start_lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_start)


def _tell_last(worker: ProcessWorker) -> None:
    """Give the notices that a worker sent while it closed its environments."""
    channel = worker.channel
    with suppress(Exception):  # a process that was ended may leave half a message
        while channel is not None and channel.pipe.poll():
            for text in channel.receive()[2]:
                notice(text)
