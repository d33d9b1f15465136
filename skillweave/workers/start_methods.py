"""Reasons why this program cannot start processes."""

from __future__ import annotations

import ast
import multiprocessing as mp
import sys
import threading
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

from skillweave.errors import DeclarationError
from skillweave.workers.shipping import packed

GUARD = "put what trains inside a block that begins with: if __name__ == '__main__':"


def why_no_processes() -> str:
    """Return why no process can be started here; empty if one can."""
    if mp.current_process().daemon:
        return "this process is a daemon of multiprocessing, which may not have processes"
    return ""


def start_method() -> str:
    """Return the start method of processes, without fixing it if the program has not chosen."""
    return mp.get_start_method(allow_none=True) or mp.get_all_start_methods()[0]


def runs_again() -> str:
    """Return why processes would run this program again; empty if they would not.

    Processes that are not forked import the program's main file. If that trains outside of a
    guard, each of them would train again, which Python refuses.
    """
    method = start_method()
    main = sys.modules.get("__main__")
    if method == "fork" or not isinstance(main, ModuleType) or not _is_imported(main):
        return ""
    if main.__name__ == "__mp_main__":  # this process has itself imported it
        return ""
    line = _line_of(main)
    if line is not None and _is_guarded(str(main.__file__), line):
        return ""
    return (
        f"processes are started by {method!r} here, which imports {Path(str(main.__file__)).name} "
        f"again in each: {GUARD}"
    )


def cannot_be_sent(things: Any) -> str:
    """Return why things cannot be sent to a process that is not forked; empty if they can."""
    if start_method() == "fork":
        return ""
    try:
        packed(things, "this declaration")
    except DeclarationError as error:
        return str(error)
    return ""


def _is_imported(main: ModuleType) -> bool:
    """Return True if a process that is not forked imports the main module."""
    file = getattr(main, "__file__", None)
    named = getattr(getattr(main, "__spec__", None), "name", None)
    return bool(named or (isinstance(file, str) and Path(file).is_file()))


def _line_of(main: ModuleType) -> int | None:
    """Return the line of the main module that runs now, and may start workers; None: ended."""
    frame: FrameType | None = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None:
        if frame.f_globals is vars(main) and frame.f_code.co_name == "<module>":
            return frame.f_lineno
        frame = frame.f_back
    return None


def _is_guarded(file: str, line: int) -> bool:
    """Return True if a line that starts workers is in a block that only the program runs."""
    try:
        tree = ast.parse(Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return False
    return any(
        isinstance(node, ast.If)
        and _asks_for_main(node.test)
        and node.body[0].lineno <= line <= (node.body[-1].end_lineno or 0)
        for node in tree.body
    )


def _asks_for_main(test: ast.expr) -> bool:
    """Return True if a condition holds only in the program itself, not in its workers."""
    if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And):
        return any(map(_asks_for_main, test.values))
    return (
        isinstance(test, ast.Compare)
        and len(test.ops) == 1
        and isinstance(test.ops[0], ast.Eq)
        and {_word(test.left), _word(test.comparators[0])} == {"__name__", "__main__"}
    )


def _word(node: ast.expr) -> Any:
    if isinstance(node, ast.Name):
        return node.id
    return node.value if isinstance(node, ast.Constant) else None
