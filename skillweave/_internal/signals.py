"""Handlers of signals that belong to this process alone.

A forked process inherits its parent's handlers. An environment may fork for its simulator; that
process must end at a signal, and not run this process's handler.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from typing import Any

_IN_FORKS: dict[int, Any] = {
    signal.SIGINT: signal.SIG_IGN,  # Ctrl-C reaches all, and the run needs its simulators to save
    signal.SIGTERM: signal.SIG_DFL,
}
_set_here: dict[int, Any] = {}


def handle_here(number: int, handler: Any) -> None:
    """Set a handler of SIGINT or SIGTERM that processes forked from this one do not inherit."""
    signal.signal(number, handler)
    _set_here[number] = handler


def stop_handling(number: int, before: Any) -> None:
    """Restore the handler from before ``handle_here``."""
    _set_here.pop(number, None)
    signal.signal(number, before)


def _leave_to_parent() -> None:
    for number, handler in _set_here.items():
        if signal.getsignal(number) is handler:  # an environment may have set another one
            with suppress(ValueError):
                signal.signal(number, _IN_FORKS[number])
    _set_here.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)
