"""One tree of seeds: every random stream is derived by name from the run's seed (contract 8).

Streams are derived afresh wherever they are needed ("the noise of update 17 of stage landing"),
so no generator's state has to be saved for a run to resume exactly.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Seeds:
    """A node of the seed tree; ``Seeds(7) / "landing" / 17`` is a node two levels below.

    ```python
    import skillweave as sw

    noise = (sw.Seeds(7) / "landing" / 17).numpy().normal(size=3)  # always the same three
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
        """A 31-bit seed for engines that take one number."""
        return int(self._sequence().generate_state(1, np.uint32)[0] >> 1)

    def integers(self, n: int) -> list[int]:
        """``n`` 31-bit seeds."""
        return [int(s >> 1) for s in self._sequence().generate_state(n, np.uint32)]

    def numpy(self) -> np.random.Generator:
        """A NumPy generator at this node."""
        return np.random.Generator(np.random.PCG64(self._sequence()))

    def torch(self) -> torch.Generator:
        """A torch CPU generator at this node."""
        import torch

        state = self._sequence().generate_state(1, np.uint64)
        return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
