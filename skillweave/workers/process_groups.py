"""Process groups: a worker and the processes that its environments start are one group.

A worker that is killed cannot end these processes. Its group outlives it, so they can still be
found and ended, however they were started. A process that has left the group, as a daemon does,
stays.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from time import monotonic, sleep

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
