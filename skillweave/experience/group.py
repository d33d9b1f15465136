"""Several collectors that fill one batch, in this thread or elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.errors import DeclarationError, RunError
from skillweave.experience.acting import Request
from skillweave.experience.collector import Collected, Collector, joined_collected
from skillweave.policies.core import Array

MakeCollector = Callable[[int, int], Collector]
"""Given how many environments and the number of the first one, makes a collector."""


class CollectorGroup:
    """W collectors of as many environments each, whose experience stands side by side.

    Each has a part of the environments of every member. What they find depends on how many they
    are, and not on where they run.

    Args:
        num_envs: of all collectors.
        members: P.
    """

    def __init__(self, num_envs: int, members: int) -> None:
        self.num_envs = num_envs
        self.members = members
        self.steps_made = 0
        """Environment steps that were made together."""
        self.restarts = 0
        """Environments that were lost with their worker, and did not repeat themselves."""

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        raise NotImplementedError

    def collect(self, request: Request) -> Collected:
        """``request.rows`` steps of each environment."""
        raise NotImplementedError

    def state(self) -> dict[str, Array]:
        """Return what ``restore`` needs. It changes nothing."""
        raise NotImplementedError

    def restore(self, state: dict[str, Array]) -> Array:
        """Restore the open episodes of ``state``; return (k,) environments that start again."""
        raise NotImplementedError

    def take_restarted(self) -> Array:
        """Return the environments (k,) that could not be restored with a lost worker, each once.

        Learners have seen them elsewhere, so their open episodes are cut.
        """
        return np.empty(0, np.int64)

    def finish(self) -> None:
        """Check at the end of training what it has left in the environments."""
        raise NotImplementedError

    def close(self) -> None:
        """Release the environments."""
        raise NotImplementedError

    def _joined(self, found: Sequence[Collected]) -> Collected:
        collected = joined_collected(found, self.members)
        self.steps_made += collected.steps
        return collected

    def _columns(self, ids: Sequence[Array]) -> Array:
        """Environments of each collector as columns of the experience."""
        count = len(ids)
        each = self.num_envs // self.members  # of a member
        own = each // count  # of a member, in one collector
        found = [part // own * each + number * own + part % own for number, part in enumerate(ids)]
        return np.sort(np.concatenate(found))


class Collectors(CollectorGroup):
    """Collectors in this thread.

    Args:
        parts: the collectors.
        members: P.
    """

    def __init__(self, parts: Sequence[Collector], members: int = 1) -> None:
        super().__init__(sum(part.num_envs for part in parts), members)
        self.parts = list(parts)

    def start(self, seeds: Seeds) -> None:
        """Start every environment, unless they have started."""
        for i, part in enumerate(self.parts):
            part.start(seeds / i)

    def collect(self, request: Request) -> Collected:
        """Step each environment ``request.rows`` times, and return the joined rows."""
        found = [part.collect(request.of_collector(i)) for i, part in enumerate(self.parts)]
        return self._joined(found)

    def state(self) -> dict[str, Array]:
        """Return the states of all collectors, joined, for ``restore``; nothing changes."""
        return joined_states([part.state() for part in self.parts])

    def restore(self, state: dict[str, Array]) -> Array:
        """Restore the open episodes of ``state``; return (k,) environments that start again."""
        states = split_states(state, len(self.parts))
        return self._columns([p.restore(s) for p, s in zip(self.parts, states, strict=True)])

    def finish(self) -> None:
        """Check at the end of training that it has left nothing in the environments."""
        for part in self.parts:
            part.finish()

    def close(self) -> None:
        """Release the environments."""
        for part in self.parts:
            part.close()


def joined_states(states: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """Return the states of a group's collectors as one, for a checkpoint; see ``split_states``."""
    found: dict[str, Array] = {"collectors": np.array([len(states)])}
    for i, state in enumerate(states):
        found |= prefixed(str(i), state)
    return found


def split_states(state: dict[str, Array], count: int) -> list[dict[str, Array]]:
    """Return the states of each of ``count`` collectors.

    Raises:
        RunError: it is that of another number of collectors.
    """
    saved = int(state["collectors"][0])
    if saved != count:
        raise RunError(
            f"the checkpoint is of {saved} collectors, but there are {count}: a run goes on with "
            "as many as it began with"
        )
    return [unprefixed(str(i), state) for i in range(count)]


def share_of(num_envs: int, workers: int, members: int, name: str) -> int:
    """Return the number of environments of each of several collectors, equally for members.

    Raises:
        DeclarationError: they cannot be.
    """
    if num_envs % (workers * members):
        raise DeclarationError(
            f"{name}: num_envs is {num_envs // members}; it must be a multiple of workers, "
            f"{workers}, so that each has as many environments"
        )
    return num_envs // workers
