"""The lineage of a population, as it is written into a run."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.evolution.config import Evolution
from skillweave.evolution.stacks import Member
from skillweave.networks.config import Network
from skillweave.runs.directory import RunDirectory
from skillweave.types import Array, SkillweaveError


class Lineage:
    """``lineage.jsonl``: who descends from whom, what changed, and how good it was."""

    def __init__(self, run: RunDirectory, size: int | None) -> None:
        self._path = run.path / "lineage.jsonl"
        if size is not None and self.size > size:  # what follows is about to be written again
            with self._path.open("rb+") as file:
                file.truncate(size)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._path.stat().st_size if self._path.exists() else 0

    def write(
        self,
        phase: str,
        generation: int,
        members: list[Member],
        fitness: Array,
        evolution: Evolution,
        best: int | None,
    ) -> None:
        """A line for each member of a generation; ``best``: who is the best so far, if of these.

        Raises:
            SkillweaveError: the disk is full or cannot be written.
        """
        lines = []
        for member, value in zip(members, fitness, strict=True):
            origin = member.origin
            line = {
                "phase": phase,
                "generation": generation,
                "member": member.number,
                "parent": origin.parent,
                "mutation": origin.mutation,
                "changes": {k: list(v) for k, v in origin.changes.items()},
                "fitness": float(value) if np.isfinite(value) else None,
                "diverged": not np.isfinite(value),
                "best": member.number == best,
                "steps": member.steps,
                "settings": settings_of(member.config, evolution),
            }
            lines.append(json.dumps(line) + "\n")
        try:
            with self._path.open("a") as file:
                file.writelines(lines)
        except OSError as error:
            raise SkillweaveError(
                f"could not write {self._path}: {error.strerror}. The last complete generation is "
                f"intact; free space, then: skillweave resume {self._path.parent}"
            ) from error


def settings_of(config: AlgorithmConfig, evolution: Evolution) -> dict[str, Any]:
    """What evolution may change of a member's settings, by name."""
    ranges = evolution.mutations.ranges_of(config, start=False)
    found: dict[str, Any] = {name: getattr(config, name) for name in ranges}
    network: Network = config.network
    found |= {"hidden": list(network.hidden), "activation": network.activation}
    return found
