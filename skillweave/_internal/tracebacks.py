"""Lines of a traceback that are the user's own, and tracebacks that show only these.

This module imports nothing of the library, so that ``types`` can import it.
"""

from __future__ import annotations

import os
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

LIBRARY = Path(__file__).parents[1]
RECIPES = LIBRARY / "recipes"
"""Shipped recipes are examples of what a user writes, so their lines count as the user's."""
SWITCH = "SKILLWEAVE_TRACEBACK"
"""The environment variable that shows the library's frames, too."""
SENT = "<dynamic-code>"
"""The file name that cloudpickle gives to code that was sent to another process."""
_STANDARD = tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib"))
_PACKAGES = {"site-packages", "dist-packages"}


def all_frames_wanted() -> bool:
    """Return whether the user wants the library's frames."""
    return os.environ.get(SWITCH, "") not in ("", "0")


def place(error: BaseException) -> str:
    """Return the file and the line where the user's code raised ``error``; "" if unknown.

    Where no frame is the user's, the last one outside this library counts. The message of a
    SyntaxError has its place already.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return ""
    frames = list(traceback.walk_tb(error.__traceback__))
    written = [(f, line) for f, line in frames if is_own(f)]
    written = written or [(f, line) for f, line in frames if not _is_hidden(_file(f))]
    if not written:
        return ""
    frame, line = written[-1]
    return f"{_name(frame)}, line {line}"


def is_own(frame: FrameType) -> bool:
    """Return whether a frame runs the user's code: no package's, and not Python's own."""
    file = _file(frame)
    if file == "<string>":  # `python -c`; elsewhere code that was generated, as of dataclasses
        return frame.f_globals.get("__name__") == "__main__"
    return _is_own_file(file)


def is_own_code(code: Any) -> bool:
    """Return whether a class or a function is the user's."""
    return is_own_module(code.__module__)


def is_own_module(name: str | None) -> bool:
    """Return whether a module of this name is the user's; code that ``exec`` made has none."""
    if name is None:
        return True
    file = getattr(sys.modules.get(name), "__file__", None)
    if file is None:  # typed into a prompt, or loaded from a file under no name
        return name.partition(".")[0] not in {"skillweave", *sys.stdlib_module_names}
    return _is_own_file(file)


def _is_own_file(file: str) -> bool:
    """Return whether a file of a traceback is the user's: no package's, and not Python's."""
    if file.startswith("<"):
        return file.startswith((SENT, "<stdin>", "<ipython-input-"))
    path = Path(file)
    if _is_library(file) or _PACKAGES & set(path.parts):
        return False
    return not any(path.is_relative_to(standard) for standard in _STANDARD)


def is_users(error: BaseException) -> bool:
    """Return whether the user's code raised ``error`` below the function that caught it."""
    return any(is_own(frame) for frame, _ in traceback.walk_tb(error.__traceback__))


class ShortTraceback(BaseException):
    """An exception whose traceback in a notebook or in IPython shows the user's lines alone."""

    def _render_traceback_(self) -> list[str]:
        """Return the lines that IPython shows; it looks for this method."""
        shell: Any = sys.modules["IPython"].get_ipython()
        error: BaseException = self
        # The first frame is IPython's own.
        frames = self.__traceback__
        offset = 1
        if not all_frames_wanted():
            # The same error without its causes: its message names them.
            error = type(self).__new__(type(self))
            error.args = self.args
            frames = _joined(list(_written(self)))
            offset = 0
        show = shell.InteractiveTB.structured_traceback
        lines: list[str] = show(type(error), error, frames, tb_offset=offset)
        return lines


def _written(error: BaseException) -> Iterator[TracebackType]:
    """Yield the user's part of a traceback, then of what caused the error."""
    at = error.__traceback__
    while at is not None:
        if is_own(at.tb_frame):
            yield at
        at = at.tb_next
    if error.__cause__ is not None:
        yield from _written(error.__cause__)


def _joined(entries: list[TracebackType]) -> TracebackType | None:
    """Return one traceback of these entries."""
    found = None
    for entry in reversed(entries):
        found = TracebackType(found, entry.tb_frame, entry.tb_lasti, entry.tb_lineno)
    return found


def _file(frame: FrameType) -> str:
    return frame.f_code.co_filename


def _is_library(file: str) -> bool:
    path = Path(file)
    return path.is_relative_to(LIBRARY) and not path.is_relative_to(RECIPES)


def _is_hidden(file: str) -> bool:
    return _is_library(file) or file.startswith("<frozen")


def _name(frame: FrameType) -> str:
    """Return the name of a frame's file for people; in a notebook the cell."""
    file = _file(frame)
    if file == SENT:  # the file is still there where it was a module's or a script's
        known = frame.f_globals.get("__file__")
        return Path(known).name if isinstance(known, str) else f"{frame.f_code.co_name}()"
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if shell is not None and hasattr(shell.compile, "format_code_name"):
        kind_and_name = shell.compile.format_code_name(file)
        if kind_and_name is not None:
            return " ".join(kind_and_name)
    return Path(file).name
