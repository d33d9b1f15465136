"""What a run's ``lineage.jsonl`` says: generations, and the ancestors of the winner."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from skillweave.runs.lines import JsonLines
from skillweave.types import SkillweaveError


@dataclass(frozen=True)
class Born:
    """A member in a generation."""

    generation: int
    member: int
    parent: int | None
    """Its number in the generation before; itself where it went on."""
    mutation: str
    changes: dict[str, list[Any]]
    fitness: float | None
    best: bool
    """Whether it was the best so far."""
    settings: dict[str, Any]


@dataclass(frozen=True)
class Lineage:
    """One phase's population over the generations."""

    born: dict[tuple[int, int], Born]
    """By generation and number."""

    @property
    def winner(self) -> Born:
        """The best of all so far."""
        return max((b for b in self.born.values() if b.best), key=lambda b: b.generation)

    def parent(self, born: Born) -> Born | None:
        """Where a member comes from; None: from the start."""
        if born.parent is None or born.generation == 0:
            return None
        return self.born.get((born.generation - 1, born.parent))

    def path(self, born: Born) -> list[Born]:
        """From the first generation to a member."""
        found: list[Born] = []
        at: Born | None = born
        while at is not None:
            found.append(at)
            at = self.parent(at)
        return found[::-1]


def read_lineage(run: Path, phase: str) -> Lineage | None:
    """The lineage of a phase, or None where nothing evolved in it.

    Raises:
        SkillweaveError: the file is damaged.
    """
    lines, born = JsonLines(run / "lineage.jsonl"), {}
    names = [f.name for f in fields(Born)]
    for number, told in enumerate(lines.read(), 1):
        try:
            if told["phase"] == phase:
                each = Born(**{k: told[k] for k in names})
                born[each.generation, each.member] = each
        except KeyError as error:
            raise SkillweaveError(
                f"{lines.path} is damaged in line {number}: no {error}"
            ) from error
    return Lineage(born) if any(b.best for b in born.values()) else None
