"""Selection of parents: the protocol, tournaments, and truncation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave.errors import TrainingError
from skillweave.evolution.config import Evolution, Tournament, Truncation
from skillweave.policies.core import Array


@checked_names
@dataclass(frozen=True)
class Heir:
    """A place in the next generation: its parent, and whether it mutates."""

    parent: int  # a row of the generation before
    mutates: bool  # False: it is an unchanged copy of the parent


class ParentSelection(Protocol):
    """A rule that selects the next generation by fitness; pass your own to ``Evolution``."""

    def select(self, fitness: Array, rng: np.random.Generator) -> list[Heir]:
        """Return one heir for each member.

        Args:
            fitness: (P,); higher is better, −inf for members that have diverged.
            rng: the only source of randomness, so that a run can be resumed.

        Returns:
            P heirs, each with its parent's row and whether it mutates.
        """
        ...


def select(evolution: Evolution, fitness: Array, rng: np.random.Generator) -> list[Heir]:
    """Select the next generation by the declared rule, without heirs of diverged members.

    Raises:
        TrainingError: all members have diverged, or a user's selection is wrong.
    """
    if not np.isfinite(fitness).any():
        raise TrainingError(
            "every member has diverged: lower the learning rate, or its range; the last complete "
            "generation is saved"
        )
    chosen = evolution.selection
    if isinstance(chosen, Tournament):
        return _tournament(chosen, fitness, rng)
    if isinstance(chosen, Truncation):
        return _truncation(chosen, fitness, rng)
    heirs: list[Heir] = chosen.select(fitness.copy(), rng)
    right = len(heirs) == len(fitness) and all(0 <= h.parent < len(fitness) for h in heirs)
    if not right or not all(np.isfinite(fitness[h.parent]) for h in heirs):
        raise TrainingError(
            f"{type(chosen).__name__}.select() must return an Heir for each of the "
            f"{len(fitness)} members, none of a parent with fitness -inf; it returned {heirs}"
        )
    return heirs


def _tournament(by: Tournament, fitness: Array, rng: np.random.Generator) -> list[Heir]:
    """Select heirs: each parent is the best of a few members drawn at random."""
    able = np.flatnonzero(np.isfinite(fitness))
    heirs = [Heir(int(fitness.argmax()), False)] if by.elitism else []
    while len(heirs) < len(fitness):
        drawn = rng.choice(able, min(by.size, len(able)), replace=False)
        heirs.append(Heir(int(drawn[fitness[drawn].argmax()]), True))
    return heirs


def _truncation(by: Truncation, fitness: Array, rng: np.random.Generator) -> list[Heir]:
    """Select heirs: the worst members are replaced by heirs of the best."""
    order = np.argsort(-fitness, kind="stable")
    count = max(1, round(by.share * len(fitness)))
    able = order[: min(count, int(np.isfinite(fitness).sum()))]
    replaced = set(order[len(order) - count :].tolist()) - {int(order[0])}
    replaced |= set(np.flatnonzero(~np.isfinite(fitness)).tolist())
    return [
        Heir(int(rng.choice(able)), True) if i in replaced else Heir(i, False)
        for i in range(len(fitness))
    ]
