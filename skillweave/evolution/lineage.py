"""Lines of ``lineage.jsonl``: each member's parent, changes and fitness.

Stands alone because it is the content of a file, which ``stage`` writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.evolution.config import Evolution
from skillweave.evolution.stacks import Member
from skillweave.networks.config import Network
from skillweave.types import Array


def lineage_of(
    stage: str,
    generation: int,
    members: Sequence[Member],
    fitness: Array,
    evolution: Evolution,
    best: int | None,
) -> list[dict[str, Any]]:
    """Return a generation's lines; ``best``: the best member's number, if it is among them."""
    return [
        {
            "stage": stage,
            "generation": generation,
            "member": member.number,
            "parent": member.origin.parent,
            "mutation": member.origin.mutation,
            "changes": {k: list(v) for k, v in member.origin.changes.items()},
            "fitness": float(value) if np.isfinite(value) else None,
            "diverged": not np.isfinite(value),
            "best": member.number == best,
            "steps": member.steps,
            "settings": settings_of(member.config, evolution),
        }
        for member, value in zip(members, fitness, strict=True)
    ]


def settings_of(config: AlgorithmConfig, evolution: Evolution) -> dict[str, Any]:
    """Return the settings of a member that evolution may change, by name."""
    ranges = evolution.mutations.ranges_of(config, start=False)
    settings: dict[str, Any] = {name: getattr(config, name) for name in ranges}
    network: Network = config.network
    settings |= {"hidden": list(network.hidden), "activation": network.activation}
    return settings
