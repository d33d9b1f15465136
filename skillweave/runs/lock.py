"""One process at a time trains a run: a lock that the system releases when its process dies."""

from __future__ import annotations

import os
import platform
from contextlib import suppress
from pathlib import Path

from skillweave.errors import RunError

try:
    import fcntl
except ImportError:  # Windows: nothing keeps two processes apart there
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"
"""The file in the run that is locked; it holds the number of the process and its machine."""
_held: set[int] = set()


class Lock:
    """Held from ``__init__`` to ``release``."""

    def __init__(self, directory: Path) -> None:
        """Take it.

        Raises:
            RunError: another process has it, or the directory cannot be written.
        """
        self._directory, self._path = directory, directory / NAME
        self.exclusive = False
        """The system keeps other processes away."""
        self._open()
        self._lock()
        if self.exclusive and os.fstat(self._handle).st_nlink > 1:
            # The run was copied by hard links (cp -al): the copy gets a lock of its own.
            with suppress(FileNotFoundError):
                os.unlink(self._path)
            self.release()
            self._open()
            self._lock()
        if self.exclusive:
            with suppress(OSError):  # it is for messages alone
                os.ftruncate(self._handle, 0)
                os.write(self._handle, f"{os.getpid()} {platform.node()}\n".encode())

    def _lock(self) -> None:
        """Lock the file that is open, where the system can.

        Raises:
            RunError: another process has locked it.
        """
        self.exclusive = False
        if fcntl is None:
            return
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = self._owner()
            self.release()
            raise RunError(
                f"{self._directory} is being trained by {owner}; wait until it ends, or stop it"
            ) from error
        except OSError:  # a file system without locks
            return
        self.exclusive = True

    def _open(self) -> None:
        """Open the file, which is made if it is not there."""
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        try:
            self._handle = os.open(self._path, flags, 0o666)
        except OSError as error:
            raise RunError(f"could not write {self._path}: {error.strerror}") from error
        _held.add(self._handle)

    def _owner(self) -> str:
        """Return which process holds it, as far as the file says."""
        number, _, machine = self._path.read_bytes()[:300].decode(errors="replace").partition(" ")
        if not number.isdecimal():
            return "another process"
        if int(number) == os.getpid() and machine.strip() == platform.node():
            return "another run of this process"
        where = "" if machine.strip() == platform.node() else f" on {machine.strip()}"
        return f"process {number}{where}"

    def check(self) -> None:
        """Raise a RunError where the run is not there any more."""
        try:
            there = os.path.samestat(os.stat(self._path), os.fstat(self._handle))
        except OSError:
            there = False
        if not there:
            raise RunError(
                f"{self._directory} was deleted or moved while it was being trained; training ends "
                "here, for there is no run to write to"
            )

    def release(self) -> None:
        """Let it go, if it is held."""
        if self._handle in _held:
            _held.discard(self._handle)
            os.close(self._handle)


def _let_go() -> None:
    """In a process forked from this one: a worker must not hold the lock when its parent dies."""
    for handle in _held:
        os.close(handle)
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)
