"""The number of torch's threads, and a worker thread beside the one that collects."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any, TypeVar

import torch

T = TypeVar("T")


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Use ``count`` torch threads within the block, and the previous number after it."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class WorkThread:
    """A thread that runs jobs one after another; it starts with the first job.

    An executor of ``concurrent.futures`` accepts no jobs after the main thread has ended, but other
    threads of the program may still train.

    Args:
        name: the thread's name.
        threads: the number of threads that torch may use in it.
    """

    def __init__(self, name: str, threads: int) -> None:
        self._name = name
        self._threads = threads
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def submit(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        """Call ``function(*arguments)`` in the thread, after the jobs before it."""
        future: Future[T] = Future()

        def job() -> None:
            try:
                future.set_result(function(*arguments))
            except BaseException as error:
                future.set_exception(error)

        self._jobs.put(job)
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name=self._name)
            self._thread.start()
        return future

    def close(self) -> None:
        """Finish all jobs, then end the thread."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join()

    def _work(self) -> None:
        torch.set_num_threads(self._threads)  # torch's number of threads is a setting per thread
        while (job := self._jobs.get()) is not None:
            job()
            del job  # its future holds the result
