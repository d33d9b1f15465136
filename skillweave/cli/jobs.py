"""Jobs side by side, each in a fresh process that ends when this one does, however it ends.

``ProcessPoolExecutor`` does not serve: where each of its processes does one job alone
(``max_tasks_per_child=1``), it may wait forever at its shutdown.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Self

from skillweave._internal.parent_process import when_parent_ends
from skillweave.errors import SkillweaveError, TrainingError, reworded

PATIENCE = 1.0
"""Seconds between looks whether a job's process is still there."""
_START = multiprocessing.get_context("spawn")


class ProcessEnded(TrainingError):
    """A job's process was ended before it answered."""


class Processes:
    """A pool of fresh processes for a sweep's runs; an error in its block ends them all."""

    def __init__(self, count: int) -> None:
        self._threads = ThreadPoolExecutor(count)
        self._lock = threading.Lock()
        self._running: list[Any] = []
        self._over = False

    def submit(self, job: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start ``job(*arguments)`` in a process; both must be importable there.

        Its result raises a ``SkillweaveError`` as the job did, a ``RuntimeError`` with the
        traceback for any other error, and ``ProcessEnded``.
        """
        return self._threads.submit(self._run, job, arguments)

    def _run(self, job: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """Run a job in a fresh process, and return its result."""
        receiver, sender = _START.Pipe(duplex=False)
        child = _START.Process(target=_answer, args=(sender, job, arguments))
        with self._lock:
            if self._over:
                raise ProcessEnded("a job was not started, as another one failed")
            child.start()
            self._running.append(child)
        sender.close()
        try:
            # A process that the job has started may hold its pipes when the job has ended: so look.
            while not receiver.poll(PATIENCE) and child.exitcode is None:
                pass
            if not receiver.poll():
                raise EOFError
            result, error = receiver.recv()
        except (EOFError, OSError):
            child.join()
            raise ProcessEnded(
                f"a process was ended before its job was done (exit code {child.exitcode}), "
                "perhaps because memory ran out"
            ) from None
        finally:
            receiver.close()
            child.join()
            with self._lock:
                self._running.remove(child)
        if error is not None:
            raise error
        return result

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        """Wait for all jobs; after an error end them, and start no other."""
        if error is not None:
            with self._lock:
                self._over = True
                for child in self._running:
                    child.terminate()
        self._threads.shutdown()


def _answer(sender: Any, job: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Do a job of a sweep in its process, and send its result or its error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    when_parent_ends(lambda: os._exit(1))
    result: Any = None
    problem: Exception | None = None
    try:
        result = job(*arguments)
    except SkillweaveError as error:
        problem = reworded(error, str(error))
    except KeyboardInterrupt:
        os._exit(128 + signal.SIGTERM)  # its run has saved; the parent has the reason
    except Exception:  # any error of a user's code; not all of them can be sent
        problem = RuntimeError(traceback.format_exc())
    try:
        sender.send((result, problem))
    except Exception:  # a result that cannot be sent
        sender.send((None, RuntimeError(traceback.format_exc())))
