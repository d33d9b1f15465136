"""Processes that tests wait for: a busy machine takes its time to end them."""

import time
from collections.abc import Iterable
from pathlib import Path


def alive(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def all_end(pids: Iterable[int], seconds: float = 60.0) -> bool:
    """Wait until no process runs; return False if one still does after ``seconds``."""
    pids, until = list(pids), time.monotonic() + seconds
    while any(map(alive, pids)) and time.monotonic() < until:
        time.sleep(0.02)
    return not any(map(alive, pids))
