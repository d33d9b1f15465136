"""What both loops do for each member of a stack, and when something is due."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from skillweave.seeding import Seeds
from skillweave.spaces import to_tensor
from skillweave.types import Array


@dataclass
class Stack:
    """Members of one architecture, and the algorithm that they learn by."""

    algorithm: Any
    state: Any  # of P members

    @property
    def members(self) -> int:
        """P."""
        return len(self.state.params)


def by_member(rows: Array, members: int) -> Tensor:
    """Rows of environments (P·B, ...) to (P, B, ...), member 0's first."""
    tensor = to_tensor(rows)
    return tensor.view(members, -1, *tensor.shape[1:])


def member_seeds(seeds: Seeds, name: str, members: int, update: int, first: int = 0) -> list[Seeds]:
    """A node of the seed tree for each member from ``first`` on."""
    return [seeds / name / (first + member) / update for member in range(members)]


def passed(every: int, before: int, after: int) -> bool:
    """Whether a multiple of ``every`` lies between ``before`` and ``after``, or is ``after``."""
    return after // every > before // every
