"""Experience that goes from one process to another in shared memory."""

from __future__ import annotations

from dataclasses import dataclass, fields
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np

from skillweave.collecting.collector import Collected
from skillweave.experience import Experience
from skillweave.types import Array, prefixed, unprefixed


@dataclass
class SharedColumns:
    """An experience whose arrays lie in shared memory: where, of which kind, and which shape."""

    name: str  # of the memory; "" where it is known
    places: dict[str, tuple[int, Any, tuple[int, ...]]]
    spent: int
    episodes: Array
    stands: Array | None
    info_keys: frozenset[str]
    longest: int

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
        experience = _experience(found, self.spent)
        return memory, Collected(
            experience, self.episodes, self.stands, info_keys=self.info_keys, longest=self.longest
        )


def _experience(found: dict[str, Array], spent: int = 0) -> Experience:
    """The inverse of ``_arrays``."""
    parts: list[Experience] = []
    while below := unprefixed(str(len(parts)), found):
        parts.append(_experience(below))
    own: dict[str, Any] = {k: v for k, v in found.items() if "." not in k}
    return Experience(**own, parts=tuple(parts), spent=spent)


def _arrays(experience: Experience) -> dict[str, Array]:
    """All arrays of an experience and of its parts, by name."""
    found = {
        f.name: value
        for f in fields(experience)
        if isinstance(value := getattr(experience, f.name), np.ndarray)
    }
    for i, part in enumerate(experience.parts):
        found |= prefixed(str(i), _arrays(part))
    return found


class ColumnWriter:
    """Puts experience into shared memory, which grows where it must."""

    def __init__(self) -> None:
        self.memory: SharedMemory | None = None

    def write(self, collected: Collected) -> SharedColumns:
        """Copy all arrays; what the parent needs to read them."""
        experience = collected.experience
        arrays = _arrays(experience)
        size = sum({id(a): _room(a) for a in arrays.values()}.values())
        name = ""
        if self.memory is None or self.memory.size < size:
            if self.memory is not None:
                self.memory.close()
            self.memory = SharedMemory(create=True, size=size + size // 4)
            name = self.memory.name
        places, at, where = {}, 0, dict[int, int]()
        for k, a in arrays.items():
            if id(a) not in where:  # parts share columns
                np.ndarray(a.shape, a.dtype, self.memory.buf, at)[...] = a
                where[id(a)], at = at, at + _room(a)
            places[k] = (where[id(a)], a.dtype, a.shape)
        return SharedColumns(
            name, places, experience.spent, collected.episodes, collected.stands,
            collected.info_keys, collected.longest,
        )  # fmt: skip


def _room(array: Array) -> int:
    """Bytes of an array, rounded up so that the next one begins where a number may."""
    return -(-array.nbytes // 64) * 64
