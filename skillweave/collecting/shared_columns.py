"""Experience that goes from one process to another in shared memory."""

from __future__ import annotations

from dataclasses import dataclass, fields
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np

from skillweave.collecting.collector import Collected
from skillweave.experience import Experience
from skillweave.types import Array


@dataclass
class SharedColumns:
    """An experience whose arrays lie in shared memory: where, of which kind, and which shape."""

    name: str  # of the memory; "" where it is known
    places: dict[str, tuple[int, Any, tuple[int, ...]]]
    spent: int
    episodes: Array

    def read(self, memory: SharedMemory | None) -> tuple[SharedMemory, Collected]:
        """The memory, and the experience: views of it, good until the next request.

        Args:
            memory: where columns came so far.
        """
        if self.name:
            if memory is not None:
                memory.close()
            memory = SharedMemory(self.name)
            memory.unlink()  # it goes when both have closed it, however they end
        assert memory is not None
        found = {
            k: np.ndarray(shape, dtype, memory.buf, at)
            for k, (at, dtype, shape) in self.places.items()
        }
        return memory, Collected(Experience(**found, spent=self.spent), self.episodes)


class ColumnWriter:
    """Puts experience into shared memory, which grows where it must."""

    def __init__(self) -> None:
        self.memory: SharedMemory | None = None

    def write(self, collected: Collected) -> SharedColumns:
        """Copy all arrays; what the parent needs to read them."""
        experience = collected.experience
        arrays = {
            f.name: value
            for f in fields(experience)
            if isinstance(value := getattr(experience, f.name), np.ndarray)
        }
        size = sum(_room(a) for a in arrays.values())
        name = ""
        if self.memory is None or self.memory.size < size:
            if self.memory is not None:
                self.memory.close()
            self.memory = SharedMemory(create=True, size=size + size // 4)
            name = self.memory.name
        places, at = {}, 0
        for k, a in arrays.items():
            np.ndarray(a.shape, a.dtype, self.memory.buf, at)[...] = a
            places[k] = (at, a.dtype, a.shape)
            at += _room(a)
        return SharedColumns(name, places, experience.spent, collected.episodes)


def _room(array: Array) -> int:
    """Bytes of an array, rounded up so that the next one begins where a number may."""
    return -(-array.nbytes // 64) * 64
