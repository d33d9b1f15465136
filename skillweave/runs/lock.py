"""The lock of a run, so one process trains it at a time; the system releases it at process end."""

from __future__ import annotations

import os
import platform
from contextlib import suppress
from pathlib import Path

from skillweave.errors import RunError

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"
"""The locked file in the run; it holds the number of the process and its machine."""
_held: set[int] = set()


class Lock:
    """A lock that is held from ``__init__`` to ``release``."""

    def __init__(self, directory: Path, name: str = NAME, *, wait: bool = False) -> None:
        """Acquire the lock.

        Args:
            name: of the locked file.
            wait: wait while another process holds it.

        Raises:
            RunError: another process holds it, or the directory cannot be written.
        """
        self._directory = directory
        self._wait = wait
        self._path = directory / name
        self._acquire()
        if self.exclusive and os.fstat(self._handle).st_nlink > 1:
            # The run was copied by hard links (cp -al): the copy gets a separate lock.
            with suppress(FileNotFoundError):
                os.unlink(self._path)
            self.release()
            self._acquire()
        if self.exclusive:
            with suppress(OSError):  # the text is only for messages
                os.ftruncate(self._handle, 0)
                os.write(self._handle, f"{os.getpid()} {platform.node()}\n".encode())

    def _acquire(self) -> None:
        """Open the file, or create it, and lock it, if the system supports it.

        Raises:
            RunError: it cannot be opened, or another process has locked it.
        """
        self.exclusive = False
        """True if the system excludes other processes."""
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        try:
            self._handle = os.open(self._path, flags, 0o666)
        except OSError as error:
            raise RunError(f"could not write {self._path}: {error.strerror}") from error
        _held.add(self._handle)
        if fcntl is None:
            return
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | (0 if self._wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            owner = self._owner()
            self.release()
            raise RunError(
                f"{self._directory} is being trained by {owner}; wait until it ends, or stop it"
            ) from error
        except OSError:  # a file system without locks
            return
        self.exclusive = True

    def _owner(self) -> str:
        """Return the process that holds the lock, as far as the file names it."""
        number, _, machine = self._path.read_bytes()[:300].decode(errors="replace").partition(" ")
        if not number.isdecimal():
            return "another process"
        if int(number) == os.getpid() and machine.strip() == platform.node():
            return "another run of this process"
        where = "" if machine.strip() == platform.node() else f" on {machine.strip()}"
        return f"process {number}{where}"

    def check(self) -> None:
        """Raise a RunError where the run no longer exists."""
        try:
            exists = os.path.samestat(os.stat(self._path), os.fstat(self._handle))
        except OSError:
            exists = False
        if not exists:
            raise RunError(
                f"{self._directory} was deleted or moved during its training; training ends, "
                "because it has no run to write to"
            )

    def release(self) -> None:
        """Release the lock, if it is held."""
        if self._handle in _held:
            _held.discard(self._handle)
            os.close(self._handle)


def _release_in_child() -> None:
    """Release all locks in a forked process: a worker must not hold one when its parent dies."""
    for handle in _held:
        os.close(handle)
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_release_in_child)
