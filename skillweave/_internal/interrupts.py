"""Ctrl-C and SIGTERM while a stage trains, and handlers of signals that forks do not inherit.

The first signal requests a checkpoint, the next stops.

Only the main thread receives signals, and only signals with the default handler of Python or the
system are handled here: a program keeps its own handlers.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from skillweave._internal.terminal import say

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_DEFAULTS = (signal.SIG_DFL, signal.default_int_handler)
_received: list[str] = []  # names of signals, while they are deferred


@contextmanager
def deferred(until: str) -> Iterator[None]:
    """Let the first interrupt set ``requested`` and the second one raise KeyboardInterrupt.

    An interrupt that is still unhandled at the end raises KeyboardInterrupt then.

    Args:
        until: when training stops, for the message.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(number: int, frame: Any) -> None:
        """Note Ctrl-C or SIGTERM; raise KeyboardInterrupt at the second one."""
        _received.append(signal.Signals(number).name)
        if len(_received) > 1:
            raise KeyboardInterrupt
        with suppress(RuntimeError):  # it may interrupt another print
            say(f"\nstopping {until}, and saving; press Ctrl-C again to stop at once")

    _received.clear()
    before = {s: signal.getsignal(s) for s in SIGNALS}
    replaced = [s for s in SIGNALS if before[s] in _DEFAULTS]
    for number in replaced:
        handle_here(number, on_signal)
    try:
        yield
        if _received:
            stop()
    finally:
        for number in replaced:
            stop_handling(number, before[number])
        _received.clear()


def requested() -> bool:
    """Return True if training is to save and stop."""
    return bool(_received)


def stop() -> NoReturn:
    """Raise KeyboardInterrupt for a deferred interrupt."""
    raise KeyboardInterrupt


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
    """Restore the signal handlers in a forked process: interrupts are left to its parent."""
    for number, handler in _set_here.items():
        if signal.getsignal(number) is handler:  # an environment may have set another one
            with suppress(ValueError):
                signal.signal(number, _IN_FORKS[number])
    _set_here.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)
