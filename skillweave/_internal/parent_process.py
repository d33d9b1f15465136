"""The parent of a process: what it starts should not outlive it."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from time import sleep

LOOK = 1.0
"""Seconds between checks that the parent lives."""


def when_parent_ends(end: Callable[[], None], parent: int | None = None) -> None:
    """Call a function soon after the parent of this process has ended, however it has.

    A thread checks the parent and calls it, because the main thread may be busy.

    Args:
        end: ends this process.
        parent: id of the parent process; None: it lives now, or a fork server started this one.
    """
    started_by = multiprocessing.parent_process()
    assert started_by is not None
    first = parent or os.getppid()

    def watch() -> None:
        # is_alive() is late where processes forked later hold copies of its pipe.
        while started_by.is_alive() and os.getppid() == first:
            sleep(LOOK)
        end()

    threading.Thread(target=watch, name="parent", daemon=True).start()
