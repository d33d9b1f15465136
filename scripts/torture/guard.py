"""Notices code that a file makes the library run: processes, sockets, writes to other places.

Python tells audit hooks of all these before they happen; a hook cannot be removed, so it looks only
while it is armed. What a file of the harness would do itself calls ``hit``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

STARTS = {
    "os.system",
    "os.exec",
    "os.fork",
    "os.forkpty",
    "os.posix_spawn",
    "os.spawn",
    "os.startfile",
    "subprocess.Popen",
    "pty.spawn",
    "socket.connect",
    "socket.bind",
    "socket.getaddrinfo",
    "webbrowser.open",
    "code.__new__",
    "function.__new__",
    "ctypes.dlopen",
    "os.kill",
    "os.putenv",
}
"""Events that no reader of a file has any need for."""
CHANGES = {
    "os.chmod",
    "os.chown",
    "os.link",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.symlink",
    "os.truncate",
    "os.utime",
    "shutil.copyfile",
    "shutil.move",
    "shutil.rmtree",
}
"""Events that may only concern the case's own folder."""
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
PREFIXES = (sys.prefix, sys.base_prefix, str(Path(__file__).parents[2]))
"""Where the code lies that may run."""


class Guard:
    """Collects what happened while it was armed."""

    def __init__(self) -> None:
        self.hits: list[str] = []
        self._folder: str | None = None
        self._hooked = False

    def hit(self, what: str) -> None:
        """Something ran that must not."""
        self.hits.append(what)

    @contextmanager
    def armed(self, folder: Path) -> Iterator[None]:
        """Look; writes below ``folder`` are allowed."""
        if not self._hooked:
            sys.addaudithook(self._see)
            self._hooked = True
        self.hits.clear()
        self._folder = str(folder)
        try:
            yield
        finally:
            self._folder = None

    def _see(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self._folder is None:
            return
        if event in STARTS:
            self.hit(f"{event} {str(arguments)[:200]}")
        elif event == "exec":
            file = getattr(arguments[0], "co_filename", "")
            if not file.startswith((*PREFIXES, "<frozen", "<string>")):
                self.hit(f"exec of {file}")
        elif event in CHANGES:
            relative = event in ("os.mkdir", "os.remove", "os.rmdir", "os.rename")
            self._within(event, arguments[0], arguments[-1] if relative else -1)
            if event in ("os.rename", "os.link", "os.symlink"):
                self._within(event, arguments[1], arguments[-1])
        elif event == "open":
            path, mode, flags = arguments
            writes = bool(flags & WRITES) if isinstance(flags, int) else False
            if writes or (isinstance(mode, str) and set(mode) & set("wax+")):
                self._within("open to write", path)

    def _within(self, event: str, path: Any, folder: int = -1) -> None:
        """See that a change is one of the case's own folder; ``folder``: what ``path`` is below."""
        if isinstance(path, int):  # a file that is open already
            return
        above = os.readlink(f"/proc/self/fd/{folder}") if folder >= 0 else ""
        whole = os.path.abspath(os.path.join(above, os.fsdecode(path)))
        if not whole.startswith((str(self._folder), "/dev/null")):
            self.hit(f"{event} {whole[:200]}")


GUARD = Guard()
"""The only one."""
