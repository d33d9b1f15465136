"""The tree of seeds: every random stream is derived by name from the run's seed.

Streams are derived wherever they are needed ("the noise of update 17 of stage landing"), so a run
can resume exactly without saved states of generators.
"""

from __future__ import annotations

import os
import random
import sys
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Seeds:
    """A node of the seed tree; ``Seeds(7) / "landing" / 17`` is a node two levels below.

    ```python
    from skillweave._internal.seeding import Seeds

    noise = (Seeds(7) / "landing" / 17).numpy().normal(size=3)  # always the same three
    ```
    """

    root: int  # the run's seed
    path: tuple[int, ...] = ()  # of keys, from the root down

    def __truediv__(self, name: str | int) -> Seeds:
        key = name if isinstance(name, int) else zlib.crc32(name.encode()) | 1 << 32
        return Seeds(self.root, (*self.path, key))

    def _sequence(self) -> np.random.SeedSequence:
        return np.random.SeedSequence(self.root, spawn_key=self.path)

    def integer(self) -> int:
        """Return a 31-bit seed for engines that take one number."""
        return int(self._sequence().generate_state(1, np.uint32)[0] >> 1)

    def integers(self, n: int) -> list[int]:
        """Return ``n`` 31-bit seeds."""
        return [int(s >> 1) for s in self._sequence().generate_state(n, np.uint32)]

    def numpy(self) -> np.random.Generator:
        """Return a NumPy generator at this node."""
        return np.random.Generator(np.random.PCG64(self._sequence()))

    def torch(self) -> torch.Generator:
        """Return a torch CPU generator at this node."""
        import torch

        state = self._sequence().generate_state(1, np.uint64)
        return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))


# The global generators of Python, NumPy and torch. The library draws from none of them, but
# environments may.


def seed_global_generators(seeds: Seeds) -> None:
    """Seed ``random``, ``numpy.random`` and torch's generator of the CPU."""
    global _changes
    _changes += 1
    python, numpy, of_torch = seeds.integers(3)
    random.seed(python)
    np.random.seed(numpy)  # noqa: NPY002
    if "torch" in sys.modules:
        sys.modules["torch"].default_generator.manual_seed(of_torch)


def global_generators_state() -> dict[str, Any]:
    """Return the states of the global generators, by their modules' names."""
    found: dict[str, Any] = {"random": random.getstate(), "numpy.random": np.random.get_state()}  # noqa: NPY002
    if "torch" in sys.modules:
        found["torch"] = sys.modules["torch"].default_generator.get_state()
    return found


class _Blocks(threading.local):
    """The blocks of ``global_generators`` that a thread is in."""

    depth = 0


_blocks = _Blocks()
_lock = threading.Lock()
_threads = 0  # in a block
_changes = 0  # of the generators, by this module
_users: dict[str, Any] = {}  # the states before the first of them began


@contextmanager
def global_generators(seeds: Seeds) -> Iterator[None]:
    """Seed the global generators within the block, and restore their states after it.

    Threads share them: while blocks of several threads overlap, the states from before the first
    block return after the last one.
    """
    global _threads, _users
    with _lock:
        before = global_generators_state()
        if not _blocks.depth:
            if not _threads:
                _users = before
            _threads += 1
        _blocks.depth += 1
    seed_global_generators(seeds)
    try:
        yield
    finally:
        with _lock:
            _blocks.depth -= 1
            if not _blocks.depth:
                _threads -= 1
            if _blocks.depth or not _threads:
                _set_states(before if _blocks.depth else _users)


def _set_states(states: dict[str, Any]) -> None:
    """Restore the states of the global random generators."""
    global _changes
    _changes += 1
    random.setstate(states["random"])
    np.random.set_state(states["numpy.random"])  # noqa: NPY002
    if "torch" in states:
        sys.modules["torch"].default_generator.set_state(states["torch"])


def _forget_threads() -> None:
    """Let a forked process begin without its parent's ``global_generators`` blocks."""
    global _blocks, _lock, _threads
    _blocks = _Blocks()
    _lock = threading.Lock()
    _threads = 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)


def are_shared() -> bool:
    """Return whether several threads train or play, so that another one may have drawn, too."""
    return _threads > 1


class GlobalDraws:
    """A detector of draws from global generators, in the first ``looks`` checks."""

    def __init__(self, looks: int) -> None:
        self.looks = looks
        """The remaining checks."""
        self._before: dict[str, bytes] = {}
        self._changes = 0

    def begin(self) -> None:
        """Store the states of the generators."""
        self._before = _fingerprints()
        self._changes = _changes

    def end(self) -> list[str]:
        """Return the modules whose generators were drawn from since ``begin``."""
        self.looks -= 1
        if _changes != self._changes:  # another thread has seeded them
            return []
        now = _fingerprints()
        return [name for name, before in self._before.items() if now[name] != before]


def _fingerprints() -> dict[str, bytes]:
    """Return bytes for each global generator that change when it is drawn from."""
    states = global_generators_state()
    _, key, *place = states["numpy.random"]
    found = {"random": repr(hash(states["random"])).encode()}
    found["numpy.random"] = key.tobytes() + repr(place).encode()
    if "torch" in states:
        found["torch"] = states["torch"].numpy().tobytes()
    return found
