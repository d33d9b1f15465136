"""The main function of a worker process, and its group: it and what its environments start."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic, sleep
from types import FrameType
from typing import Any, NoReturn

from skillweave._internal.interrupts import handle_here
from skillweave._internal.notices import Notices, collect_notices
from skillweave._internal.parent_process import when_parent_ends
from skillweave.workers.channel import Channel
from skillweave.workers.host import SentError, WorkerHost, error_to_send

GRACE = 5.0
"""Seconds that environments have to close after the parent has ended."""
AGAIN = 0.5
"""Seconds until an environment that did not end is told again."""
LEFT = 0.3
"""Seconds that processes of environments have to end, first by themselves and then by SIGTERM."""


class _Ended(BaseException):
    """The process must end: it received SIGTERM, or its parent has ended."""


@dataclass(frozen=True)
class TorchModes:
    """PyTorch's modes where a program trains: environments in other processes have them, too."""

    gradients: bool
    dtype: Any
    """The default type of tensors."""

    @classmethod
    def here(cls) -> TorchModes:
        """Return PyTorch's modes in this thread."""
        import torch

        return cls(torch.is_grad_enabled(), torch.get_default_dtype())

    def set(self) -> None:
        """Set these modes in this thread."""
        import torch

        torch.set_grad_enabled(self.gradients)
        torch.set_default_dtype(self.dtype)


def work(
    number: int,
    maker: Any,
    each: int,
    channel: Channel,
    other_end: Channel,
    parent: int | None,
    modes: TorchModes,
) -> None:
    """Answer every (what, task) with (error, result, notices), until the parent closes.

    Args:
        number: the worker's number.
        maker: its ``make`` returns the collector that works here.
        each: number of environments.
        channel: the connection to the parent.
        other_end: the parent's end of it, of which a fork has a copy.
        parent: id of the parent process; None if a fork server started this process.
        modes: of the thread that trains.
    """
    import torch

    lead_group()
    handle_here(signal.SIGINT, signal.SIG_IGN)  # at Ctrl-C the parent closes its workers
    handle_here(signal.SIGTERM, _end)
    torch.set_num_threads(1)
    modes.set()
    other_end.close()
    notices = collect_notices()
    station: WorkerHost | None = None
    closing = threading.Event()
    try:
        try:
            _end_with(parent, closing)
            _may_have_processes()
            station = WorkerHost(maker.make, each, number)
            _send(channel, None, None, notices)
            for what, task in _tasks(channel):
                torch.set_num_threads(1)  # the user's code may have changed it
                _send(channel, None, station.answer(what, task), notices)
        except _Ended:
            raise
        except BaseException as error:
            _send(channel, error_to_send(error), None, notices)
        finally:
            closing.set()
            if station is not None:
                with suppress(Exception, SystemExit):
                    station.collector.close()
            _end_children()
            if notices.any:
                _send(channel, None, None, notices)
    except _Ended:
        _end_rest_of_group()


def _tasks(channel: Channel) -> Iterator[tuple[str, Any]]:
    """Yield the parent's requests (what, task), until it closes the worker."""
    while True:
        try:
            what, task = channel.receive()
        except (EOFError, OSError):
            raise _Ended from None
        if what == "close":
            return
        yield what, task


def _send(channel: Channel, error: SentError | None, answer: Any, notices: Notices) -> None:
    """Send an answer; end this process if the parent has closed the connection."""
    try:
        channel.send((error, answer, notices.take()))
    except (BrokenPipeError, ConnectionResetError):
        raise _Ended from None


def _end(number: int, frame: FrameType | None) -> NoReturn:
    raise _Ended


def _end_with(parent: int | None, closing: threading.Event) -> None:
    """End this process soon after its parent, also during a rollout.

    Environments get time to close: they may have processes of their own. What a signal raises in
    a ``__del__`` is lost, so the signal is repeated until they close, and then no more.
    """
    main = threading.main_thread().ident
    assert main is not None

    def end() -> None:
        until = monotonic() + GRACE
        while not closing.is_set() and monotonic() < until:
            with suppress(OSError, ValueError):
                signal.pthread_kill(main, signal.SIGTERM)
            closing.wait(AGAIN)
        sleep(max(0.0, until - monotonic()))
        kill_group()

    when_parent_ends(end, parent)


def _may_have_processes() -> None:
    """Let environments start processes, which ``multiprocessing`` forbids to a daemon.

    The parent still has this process as a daemon: it does not wait for it at its own end.
    """
    with suppress(AttributeError):
        mp.current_process()._config["daemon"] = False  # type: ignore[attr-defined]


def _end_children() -> None:
    """End processes that environments have started and not ended when they were closed.

    ``multiprocessing`` would wait for them, until the parent kills this process and they stay.
    """
    children = mp.active_children()
    for child in children:
        if child.daemon:
            child.terminate()
    for seconds, end in ((LEFT, "terminate"), (LEFT, "kill")):
        until = monotonic() + seconds
        for child in children:
            child.join(max(0.0, until - monotonic()))
            if child.is_alive():
                getattr(child, end)()


PATIENCE = 0.3
"""Seconds that processes have to end at SIGTERM."""


def lead_group() -> None:
    """Let this process lead a group of its own, to which the processes that it starts belong."""
    with suppress(OSError):  # it leads a session
        os.setpgid(0, 0)


def kill_group() -> None:
    """Kill this process and its group; only itself where the group is another one's."""
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGKILL)


def _end_rest_of_group() -> None:
    """End what environments have started and left: the parent, which would, may have ended."""
    if os.getpgrp() == os.getpid():
        handle_here(signal.SIGTERM, signal.SIG_IGN)
        _signalled(os.getpid(), signal.SIGTERM)


def end_group(leader: int) -> None:
    """End the processes that are left in the group of a process that has ended."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if not _signalled(leader, number):
            return
        until = monotonic() + PATIENCE
        while _signalled(leader, 0) and monotonic() < until:
            sleep(0.01)


def _signalled(group: int, number: int) -> bool:
    """Send a signal to a group; return False if it has no processes."""
    try:
        os.killpg(group, number)
    except (ProcessLookupError, PermissionError):  # the latter on macOS, of zombies
        return False
    return True
