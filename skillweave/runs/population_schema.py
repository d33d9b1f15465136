"""The schemas of populations: lines of ``lineage.jsonl``, headers of their checkpoints."""

from __future__ import annotations

from typing import Annotated, Any, TypedDict

from skillweave.runs.manifest import Checkpoint, NodePath
from skillweave.settings import Check, Count


class MemberEntry(TypedDict):
    """A member of a population, in a checkpoint's header."""

    number: Count
    steps: Count
    config: dict[str, Any]
    origin: Origin


class Origin(TypedDict):
    """The origin of a member: its parent and its mutation."""

    parent: Count | None
    mutation: str
    changes: dict[str, tuple[Any, Any]]


class BestEntry(TypedDict):
    """The best member of a population so far."""

    fitness: float
    number: Count
    generation: Count
    policy: dict[str, Any]


class LineageLine(TypedDict):
    """A line of ``lineage.jsonl``: a member in a generation."""

    stage: NodePath
    generation: Count
    member: Count
    parent: Count | None
    mutation: str
    changes: dict[str, tuple[Any, Any]]
    fitness: float | None
    best: bool
    settings: dict[str, Any]


class Generation(Checkpoint):
    """The header of a population's checkpoint."""

    fitness_steps: Count
    generation: Count
    rounds: Count
    next_number: Count
    members: Annotated[list[MemberEntry], Check("at least one member", bool)]
    best: BestEntry
