"""Ctrl-C and SIGTERM while a stage trains: the first requests a checkpoint, the next stops.

Only the main thread receives signals, and only signals with the default handler of Python or the
system are handled here: a program keeps its own handlers.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from skillweave._internal.signals import handle_here, stop_handling
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
