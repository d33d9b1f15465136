"""Collectors in processes of their own: environments step and policies act there.

A process is asked for a whole rollout at a time. Parameters go to it as messages, columns come
back in shared memory. One that dies is made again (``workers``).
"""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.shared_memory import SharedMemory
from time import monotonic
from typing import Any

from skillweave.collecting.shared_columns import ColumnWriter, SharedColumns
from skillweave.collecting.shipping import packed, unpacked
from skillweave.collecting.workers import (
    MakeStanding,
    Station,
    WorkerCollectors,
    WorkerLost,
    Workers,
)
from skillweave.messages import told
from skillweave.types import SkillweaveError

PATIENCE = 1.0
"""Seconds that workers have to end by themselves when they are closed."""
LOOK = 1.0
"""Seconds between looks of a waiting worker at whether its parent lives."""


class _Maker:
    """What makes a collector; a process that is not forked gets it with the user's own code."""

    def __init__(self, make: MakeStanding) -> None:
        self.make = make

    def __getstate__(self) -> bytes:
        return packed(self.make, "what a worker's collector is made of")

    def __setstate__(self, data: bytes) -> None:
        self.make = unpacked(data)


class ProcessWorker:
    """A collector in a process.

    Args:
        each: its environments.
        number: of the worker.
    """

    def __init__(self, make: MakeStanding, each: int, number: int) -> None:
        self._make, self._each, self._number = make, each, number
        self._context = mp.get_context()
        self.process: Any = None
        self.pipe: Any = None
        self._memory: SharedMemory | None = None  # where its columns come

    def begin(self) -> None:
        """Start the process, which makes the collector."""
        ours, theirs = self._context.Pipe()
        about = self._number, _Maker(self._make), self._each, theirs, ours
        self.pipe = ours
        name = f"collector-{self._number}"
        self.process = self._context.Process(target=_work, args=about, name=name, daemon=True)
        self.process.start()
        theirs.close()

    def send(self, what: str, task: Any) -> None:
        """Ask for something."""
        try:
            self.pipe.send((what, task))
        except OSError:
            raise WorkerLost(self._end()) from None

    def receive(self) -> Any:
        """The next answer."""
        try:
            while not self.pipe.poll():
                # A pipe whose other end is gone is ready too; another may still hold that end.
                wait([self.pipe, self.process.sentinel])
                if not self.pipe.poll() and not self.process.is_alive():
                    raise EOFError
            error, answer = self.pipe.recv()
        except (EOFError, OSError):
            raise WorkerLost(self._end()) from None
        if error is not None:
            raise SkillweaveError(error)
        if isinstance(answer, SharedColumns):
            self._memory, answer = answer.read(self._memory)
        return answer

    def release(self) -> None:
        """Let the process close its environments; end it if it does not."""
        close_all([self])

    def forget(self) -> None:
        """Let go of its memory and its pipe."""
        if self.pipe is not None:
            self.pipe.close()
            self.pipe = None
        if self._memory is not None:
            with suppress(BufferError):  # somebody still looks at it; it goes with them
                self._memory.close()
            self._memory = None

    def _end(self) -> str:
        """How its process ended, as people say it."""
        self.process.join(PATIENCE)
        code = self.process.exitcode
        if code is None or code >= 0:
            return f"died with exit code {code}"
        how = f"died by signal {-code} ({signal.strsignal(-code)})"
        return how + (", perhaps because memory ran out" if -code == signal.SIGKILL else "")


def close_all(workers: Sequence[ProcessWorker]) -> None:
    """Let workers close their environments, all at once; end those that do not."""
    for worker in workers:
        if worker.pipe is not None:
            with suppress(OSError):
                worker.pipe.send(("close", None))
    until = monotonic() + PATIENCE
    for end in ("join", "terminate", "kill"):
        for worker in workers:
            process = worker.process
            if process is None or process.pid is None:
                continue
            if end != "join" and process.is_alive():
                getattr(process, end)()
            process.join(max(0.0, until - monotonic()))
        until = monotonic() + PATIENCE / 2
    for worker in workers:
        worker.forget()


class ProcessWorkers(Workers):
    """Workers, each in a process."""

    _workers: list[ProcessWorker]  # type: ignore[assignment]

    def close(self) -> None:
        """Let the workers close their environments; end those that do not."""
        close_all(self._workers)


def process_workers(make: MakeStanding, count: int, name: str) -> Workers:
    """``count`` workers in processes; ``make`` is given 1 and the worker's number."""
    return ProcessWorkers([ProcessWorker(make, 1, i) for i in range(count)], name)


class ProcessCollectors(ProcessWorkers, WorkerCollectors):
    """W collectors, each in a process.

    Args:
        make: makes one.
        each: environments of a worker.
        count: W.
        members: P.
        name: what messages call the environment.
    """

    def __init__(self, make: MakeStanding, each: int, count: int, members: int, name: str) -> None:
        resource_tracker.ensure_running()  # one for all, so that memory is released once
        workers = [ProcessWorker(make, each, i) for i in range(count)]
        super().__init__(workers, each, members, name)


def _tasks(pipe: Connection, first: int) -> Iterator[tuple[str, Any]]:
    """What the parent asks for, until it closes, or is no more.

    Args:
        pipe: where it asks.
        first: the process whose child this one was at first.
    """
    parent = mp.parent_process()
    assert parent is not None
    while True:
        while not pipe.poll(LOOK):
            # The first is late where later workers were forked with the pipe that tells it; the
            # second is never true where a server forks.
            if not parent.is_alive() or os.getppid() != first:
                return
        what, task = pipe.recv()
        if what == "close":
            return
        yield what, task


def _work(number: int, maker: _Maker, each: int, pipe: Connection, other_end: Connection) -> None:
    """The life of a worker: answer (error, result) to every (what, task)."""
    import torch

    first = os.getppid()  # the parent waits for our first answer; after that it may be no more
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, who then closes us
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a fork has the parent's handler
    torch.set_num_threads(1)
    other_end.close()
    station: Station | None = None
    try:
        station = Station(maker.make, each, number)
        pipe.send((None, None))
        writer = ColumnWriter()
        for what, task in _tasks(pipe, first):
            answer = station.answer(what, task)
            pipe.send((None, writer.write(answer) if what == "collect" else answer))
    except (EOFError, BrokenPipeError):
        return  # nobody is left to be told
    except SkillweaveError as error:
        pipe.send((str(error), None))
    except BaseException as error:
        pipe.send((told(error), None))
    finally:
        if station is not None:
            with suppress(BaseException):
                station.collector.close()
