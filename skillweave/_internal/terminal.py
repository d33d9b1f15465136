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

from skillweave.policies.acting_errors import RunError, printable as printable

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
        RunError: it cannot be written, for example because the disk is full.
    """
    put_line(text, sys.stdout)


def put_line(text: str, stream: Any) -> None:
    """Write a line to a stream, or nowhere if it is None; otherwise as ``put_result``."""
    if stream is None or stream.closed:
        return
    try:
        print(_encodable(printable(text), stream), file=stream, flush=True)
    except BrokenPipeError:
        _discard(stream)
    except OSError as error:
        _discard(stream)
        raise RunError(f"could not write to standard output: {error.strerror}") from error


def end_quietly() -> None:
    """Discard the buffers of closed or full streams, so that Python ends without a message."""
    for stream in (sys.stdout, sys.stderr):
        _flush(stream)


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


@contextmanager
def reserved_stdout(*, lasting: bool) -> Iterator[Any]:
    """Yield standard output as it was; all else that is written there goes to standard error.

    That is what environments, libraries, C code and other processes print within the block.

    Args:
        lasting: until this process ends, since C code may write its buffers only then.
    """
    outer = sys.stdout
    _flush(outer)
    number = os.dup(1)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    result = outer
    if _number(outer) == 1:
        result = os.fdopen(os.dup(number), "w", encoding=outer.encoding, errors=outer.errors)
    try:
        yield result
    finally:
        _flush(outer)
        if result is not outer:
            _flush(result)
            result.close()
        if not lasting:
            sys.stdout = outer
            _flush_c()
            os.dup2(number, 1)
        os.close(number)


def _flush(stream: Any) -> None:
    """Write what waits in a stream; discard it if that is not possible."""
    try:
        if stream is not None:
            stream.flush()
    except (OSError, ValueError):
        _discard(stream)


def _flush_c() -> None:
    """Write what waits in the streams of C code."""
    with suppress(Exception):  # not every system has this function
        import ctypes

        ctypes.CDLL(None).fflush(None)


def _number(stream: Any) -> int | None:
    """Return the number of the file to which a stream writes; None: it has none."""
    try:
        return int(stream.fileno())
    except Exception:  # a stream of the user's own may be anything
        return None


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
    """Open the null device under a free number, in place of a closed standard stream."""
    try:
        os.fstat(number)
    except OSError:
        with suppress(OSError):
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
