"""Collectors in processes of their own: environments step and policies act there.

A process is asked for a whole rollout at a time. Parameters go to it as messages, columns come
back in shared memory. One that dies is made again: a collector is a function of its state and of
what it is asked for, so the experience is the same.
"""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.shared_memory import SharedMemory
from time import monotonic
from typing import Any

from gymnasium.vector.utils import CloudpickleWrapper

from skillweave.collecting.acting import Request
from skillweave.collecting.collector import Collected, Collector
from skillweave.collecting.group import Collectors, joined_states, split_states
from skillweave.collecting.shared_columns import ColumnWriter, SharedColumns
from skillweave.messages import told
from skillweave.seeding import Seeds
from skillweave.types import Array, SkillweaveError

PATIENCE = 1.0
"""Seconds that workers have to end by themselves when they are closed."""
LOOK = 1.0
"""Seconds between looks of a waiting worker at whether its parent lives."""
SNAPSHOT_EVERY = 16
"""Requests after which a worker says where it stands, so that less need be done again."""


@dataclass
class _Worker:
    """A process, and what making it again would take."""

    number: int
    process: Any = None
    pipe: Any = None
    memory: SharedMemory | None = None  # where its columns come
    start: tuple[str, Any] | None = None  # how it came to where it stood first
    since: list[tuple[str, Any]] = field(default_factory=list)  # what it was asked since then


class ProcessCollectors(Collectors):
    """W collectors, each in a process.

    Args:
        make: given how many environments and the number of the first one, makes a collector.
        each: environments of a worker.
        count: W.
        members: P.
        name: what messages call the environment.

    Raises:
        SkillweaveError: an environment failed, or a process died twice at the same place; the
            message names the worker.
    """

    def __init__(
        self, make: Callable[[int, int], Collector], each: int, count: int, members: int, name: str
    ) -> None:
        self.members, self.num_envs, self.steps_made = members, each * count, 0
        self._make, self._each, self._name = make, each, name
        self.parts = []
        self._context = mp.get_context()
        resource_tracker.ensure_running()  # one for all, so that memory is released once
        self._workers = [_Worker(i) for i in range(count)]
        try:
            for worker in self._workers:
                self._begin(worker)
            for worker in self._workers:
                self._answer(worker)
        except BaseException:
            self.close()
            raise

    def start(self, seeds: Seeds) -> None:
        """Start every environment anew, unless they are under way."""
        if self._workers[0].start is None:
            self._set("start", [seeds / w.number for w in self._workers])

    def collect(self, request: Request) -> Collected:
        """``request.rows`` steps of each environment."""
        due = [(w, request.of_collector(w.number)) for w in self._workers]
        for worker, own in due:
            worker.since.append(("collect", own))
        found = self._joined(self._ask(due, "collect"))
        if len(self._workers[0].since) >= SNAPSHOT_EVERY:
            self._set("restore", self._ask_all("state", None), tell=False)
        return found

    def cut(self, seeds: Seeds) -> Array:
        """Make ready for ``state``; (k,) environments that begin anew."""
        due = [(w, seeds / w.number) for w in self._workers]
        for worker, own in due:
            worker.since.append(("cut", own))
        return self._columns(self._ask(due, "cut"))

    def state(self) -> dict[str, Array]:
        """All that ``restore`` needs, right after ``cut``."""
        states = self._ask_all("state", None)
        self._set("restore", states, tell=False)
        return joined_states(states)

    def restore(self, state: dict[str, Array]) -> Array:
        """Stand where ``state`` says; (k,) environments that begin anew."""
        return self._columns(self._set("restore", split_states(state, len(self._workers))))

    def close(self) -> None:
        """Let the workers close their environments; end those that do not."""
        for worker in self._workers:
            if worker.pipe is not None:
                with suppress(OSError):
                    worker.pipe.send(("close", None))
        until = monotonic() + PATIENCE
        for end in ("join", "terminate", "kill"):
            for worker in self._workers:
                process = worker.process
                if process is None or process.pid is None:
                    continue
                if end != "join" and process.is_alive():
                    getattr(process, end)()
                process.join(max(0.0, until - monotonic()))
            until = monotonic() + PATIENCE / 2
        for worker in self._workers:
            _release(worker)

    def _set(self, what: str, tasks: Sequence[Any], tell: bool = True) -> list[Any]:
        """Bring every worker to where it can be brought again; ``tell``: it is not there yet."""
        for worker, task in zip(self._workers, tasks, strict=True):
            worker.start, worker.since = (what, task), []
        if not tell:
            return []
        return self._ask(list(zip(self._workers, tasks, strict=True)), what)

    def _ask_all(self, what: str, task: Any) -> list[Any]:
        return self._ask([(w, task) for w in self._workers], what)

    def _ask(self, due: Sequence[tuple[_Worker, Any]], what: str) -> list[Any]:
        """Send workers their tasks; their answers, in the same order."""
        for worker, task in due:
            with suppress(OSError):  # a dead one is found when it should answer
                worker.pipe.send((what, task))
        return [self._answer(worker, what, task) for worker, task in due]

    def _answer(self, worker: _Worker, what: str = "", task: Any = None) -> Any:
        """What a worker answers; one that died is made again, once."""
        try:
            return self._receive(worker)
        except (EOFError, OSError):
            if not what:
                raise self._died(worker) from None
        try:
            return self._again(worker, what, task)
        except (EOFError, OSError):
            raise self._died(worker) from None

    def _again(self, worker: _Worker, what: str, task: Any) -> Any:
        """Make a worker again, bring it to where it was, and let it answer."""
        _release(worker)
        self._begin(worker)
        self._receive(worker)
        tasks = [worker.start] if worker.start is not None else []
        tasks += worker.since
        if not tasks or tasks[-1][0] != what or tasks[-1][1] is not task:
            tasks.append((what, task))
        answer = None
        for own in tasks:
            worker.pipe.send(own)
            answer = self._receive(worker)
        return answer

    def _begin(self, worker: _Worker) -> None:
        ours, theirs = self._context.Pipe()
        make: Any = CloudpickleWrapper(self._make)  # type: ignore[arg-type]
        about = worker.number, make, self._each, theirs, ours, os.getpid()
        worker.pipe = ours
        worker.process = self._context.Process(
            target=_work, args=about, name=f"collector-{worker.number}", daemon=True
        )
        worker.process.start()
        theirs.close()

    def _receive(self, worker: _Worker) -> Any:
        """The next answer of a worker.

        Raises:
            EOFError: its process is dead.
            SkillweaveError: it says what went wrong.
        """
        while not worker.pipe.poll():
            # A pipe whose other end is gone is ready too; another worker may still hold that end.
            wait([worker.pipe, worker.process.sentinel])
            if not worker.pipe.poll() and not worker.process.is_alive():
                raise EOFError
        error, answer = worker.pipe.recv()
        if error is not None:
            raise SkillweaveError(f"{error} (in worker {worker.number})")
        if isinstance(answer, SharedColumns):
            worker.memory, answer = answer.read(worker.memory)
        return answer

    def _died(self, worker: _Worker) -> SkillweaveError:
        worker.process.join(PATIENCE)
        code = worker.process.exitcode
        how = f"with exit code {code}"
        if code is not None and code < 0:
            how = f"by signal {-code} ({signal.strsignal(-code)})"
            how += ", perhaps because memory ran out" if -code == signal.SIGKILL else ""
        first = worker.number * self._each
        return SkillweaveError(
            f"{self._name}: the process of worker {worker.number} (environments {first} to "
            f"{first + self._each - 1}) died {how}, and again when it was made anew"
        )


def _release(worker: _Worker) -> None:
    if worker.pipe is not None:
        worker.pipe.close()
        worker.pipe = None
    if worker.memory is not None:
        with suppress(BufferError):  # somebody still looks at it; it goes with them
            worker.memory.close()
        worker.memory = None


def _tasks(pipe: Connection, parent: int) -> Iterator[tuple[str, Any]]:
    """What the parent asks for, until it closes, or is no more."""
    while True:
        while not pipe.poll(LOOK):
            if os.getppid() != parent:
                return
        what, task = pipe.recv()
        if what == "close":
            return
        yield what, task


def _work(
    number: int, make: Any, each: int, pipe: Connection, other_end: Connection, parent: int
) -> None:
    """The life of a worker: answer (error, result) to every (what, task)."""
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, who then closes us
    torch.set_num_threads(1)
    other_end.close()
    collector: Collector | None = None
    try:
        collector = make.fn(each, number * each)
        pipe.send((None, None))
        writer = ColumnWriter()
        for what, task in _tasks(pipe, parent):
            answer: Any
            answer = collector.state() if what == "state" else getattr(collector, what)(task)
            pipe.send((None, writer.write(answer) if what == "collect" else answer))
    except (EOFError, BrokenPipeError):
        return  # nobody is left to be told
    except SkillweaveError as error:
        pipe.send((str(error), None))
    except BaseException as error:
        pipe.send((told(error), None))
    finally:
        if collector is not None:
            with suppress(BaseException):
                collector.close()
