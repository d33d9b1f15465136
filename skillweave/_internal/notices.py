"""Notices: sentences for users, given once, from any module of the library.

In a run, its progress prints them. Elsewhere they are Python warnings.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Notices:
    """Notices of one run, each given once; they wait until a function to print them is set."""

    def __init__(self) -> None:
        self._said: set[str] = set()
        self._waiting: list[str] = []
        self._tell: Callable[[str], None] | None = None

    def add(self, text: str) -> None:
        """Give a notice, unless it was given before."""
        if text in self._said:
            return
        self._said.add(text)
        if self._tell is None:
            self._waiting.append(text)
        else:
            self._tell(text)

    @property
    def any(self) -> bool:
        """Return whether notices wait."""
        return bool(self._waiting)

    def take(self) -> list[str]:
        """Return the waiting notices, and remove them."""
        waiting = self._waiting
        self._waiting = []
        return waiting

    def tell_by(self, tell: Callable[[str], None] | None) -> None:
        """Print waiting and later notices with this function; None: let notices wait."""
        self._tell = tell
        if tell is not None:
            for text in self.take():
                tell(text)


_CURRENT: ContextVar[Notices | None] = ContextVar("_CURRENT", default=None)


def notice(text: str) -> None:
    """Give users a notice, once in a run."""
    notices = _CURRENT.get()
    if notices is None:
        warn(text)
    else:
        notices.add(text)


def warn(text: str) -> None:
    """Give users a notice as a Python warning."""
    warnings.warn(text, stacklevel=2)


def are_collected() -> bool:
    """Return whether this is a run or a process of one, where notices are collected."""
    return _CURRENT.get() is not None


@contextmanager
def collected_notices() -> Iterator[Notices]:
    """Collect notices within the block; in a nested block the outer one collects them."""
    if (outer := _CURRENT.get()) is not None:
        yield outer
        return
    notices = Notices()
    before = _CURRENT.set(notices)
    try:
        yield notices
    finally:
        _CURRENT.reset(before)


def collect_notices() -> Notices:
    """Collect notices from now on, in a process that sends them to another one."""
    notices = Notices()
    _CURRENT.set(notices)
    return notices
