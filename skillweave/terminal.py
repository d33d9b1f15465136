"""Text on its way to people: the one place where it leaves for a terminal.

Names and dates in a run may come from somebody else, and a terminal obeys the control characters in
them. Whoever reads may go away (``2>&1 | head``), a log's disk may be full, and a locale may know
ASCII alone. Training goes on in all of these cases.

This module imports nothing of the library, so that all of it can stand on it.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # all but tab and newline
    "\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]"  # order and lines of text
)
STANDARD = (0, 1, 2)
"""Numbers of the standard streams."""


def printable(text: str) -> str:
    """Return a text with its control characters escaped: ``\\x1b`` for the one that terminals obey.

    Tabs and newlines stay.
    """
    return _CONTROLS.sub(_escape, text)


def one_line(value: object) -> str:
    """Return a value for a place in a line, with newlines and tabs escaped, too."""
    return printable(str(value).replace("\n", "\\n").replace("\t", "\\t"))


def say(text: str = "") -> None:
    """Write a line for people to standard error; where that cannot be written, do nothing."""
    stream = sys.stderr
    if stream is None:  # without a console; ``print`` would write to standard output
        return
    try:
        print(_encodable(printable(text), stream), file=stream, flush=True)
    except (OSError, ValueError):
        _discard(stream)


def put_result(text: str = "") -> None:
    """Write a line to standard output; a reader who went away has read enough.

    Raises:
        OSError: it cannot be written, for example as the disk is full.
    """
    stream = sys.stdout
    if stream is None or stream.closed:
        return
    try:
        print(_encodable(printable(text), stream), file=stream, flush=True)
    except BrokenPipeError:
        _discard(stream)
    except OSError:
        _discard(stream)
        raise


def end_quietly() -> None:
    """Discard what a closed or full stream has not taken, so that Python ends without a message."""
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            _discard(stream)


@contextmanager
def steady_streams() -> Iterator[None]:
    """Keep the places of the standard streams taken while files are written.

    Where one of them is closed, the system gives its number to the next file that is opened, and
    whatever a library writes to standard error then lands in that file. ``sys.stderr`` that was
    closed takes no warnings; one that takes them and drops them is in its place meanwhile.
    """
    for number in STANDARD:
        _take(number)
    closed = sys.stderr
    if closed is None or not closed.closed:
        yield
        return
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        sys.stderr = nowhere
        try:
            yield
        finally:
            if sys.stderr is nowhere:
                sys.stderr = closed


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


def _encodable(text: str, stream: Any) -> str:
    """Return a text as the stream's encoding can say it."""
    encoding = getattr(stream, "encoding", None)
    if not isinstance(encoding, str):
        return text
    with suppress(LookupError):
        return text.encode(encoding, "backslashreplace").decode(encoding)
    return text


def _discard(stream: Any) -> None:
    """Drop what a stream holds and could not write; the stream itself stays as it is."""
    with suppress(Exception):  # a stream of the user's own may be anything
        number = stream.fileno()
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            before = os.dup(number)
            try:
                os.dup2(nowhere, number)
                stream.flush()
            finally:
                os.dup2(before, number)
                os.close(before)
        finally:
            os.close(nowhere)


def _take(number: int) -> None:
    """Open the null device under a number that is free."""
    try:
        os.fstat(number)
    except OSError:
        with suppress(OSError):
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
