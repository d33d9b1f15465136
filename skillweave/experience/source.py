"""What learners learn from: collectors, wherever they run."""

from __future__ import annotations

from typing import Protocol

from skillweave._internal.seeding import Seeds
from skillweave.experience.acting import Request
from skillweave.experience.collector import Collected
from skillweave.types import Array


class Source(Protocol):
    """Answers requests of learners; a function of requests, seeds and ``state``."""

    num_envs: int
    steps_made: int
    """Environment steps so far."""

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        ...

    def collect(self, request: Request) -> Collected:
        """Return ``request.rows`` rows of each environment."""
        ...

    def state(self) -> dict[str, Array]:
        """Return what ``restore`` needs; nothing changes."""
        ...

    def restore(self, state: dict[str, Array]) -> Array:
        """Continue from a ``state``; return (k,) environments that start again."""
        ...

    def differing(self) -> Array:
        """Return (k,) environments whose open trajectories end, as they were lost; once each."""
        ...

    def close(self) -> None:
        """Release what it holds."""
        ...
