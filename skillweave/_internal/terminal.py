"""The output of all text to a terminal.

Names and dates in a run may come from another person, and a terminal obeys control characters in
them. The reader may close the stream (``2>&1 | head``), a log's disk may be full, and a locale may
support only ASCII. Training continues in all of these cases.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from skillweave.policies.errors import printable as printable

STANDARD = (0, 1, 2)
"""Numbers of the standard streams."""


def one_line(value: object) -> str:
    """Format a value for a line, with newlines and tabs escaped, too."""
    return printable(str(value).replace("\n", "\\n").replace("\t", "\\t"))


def say(text: str = "") -> None:
    """Write a line for users to standard error; do nothing if that cannot be written."""
    stream = sys.stderr
    if stream is None:  # without a console; ``print`` would write to standard output
        return
    try:
        print(_encodable(printable(text), stream), file=stream, flush=True)
    except (OSError, ValueError):
        _discard(stream)


def put_result(text: str = "") -> None:
    """Write a line to standard output; ignore a reader that has closed it.

    Raises:
        OSError: it cannot be written, for example because the disk is full.
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
    """Discard the buffers of closed or full streams, so that Python ends without a message."""
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            _discard(stream)


@contextmanager
def steady_streams() -> Iterator[None]:
    """Occupy the numbers of closed standard streams while files are written.

    If one is closed, the system gives its number to the next file that is opened, and a library's
    writes to standard error would end up in that file. A closed ``sys.stderr`` is replaced by one
    that drops warnings.
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


def _encodable(text: str, stream: Any) -> str:
    """Return a text that the stream's encoding supports."""
    encoding = getattr(stream, "encoding", None)
    if not isinstance(encoding, str):
        return text
    with suppress(LookupError):
        return text.encode(encoding, "backslashreplace").decode(encoding)
    return text


def _discard(stream: Any) -> None:
    """Drop the buffer that a stream could not write; the stream itself does not change."""
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
