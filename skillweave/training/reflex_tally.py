"""Counts of the steps of an evaluation in which each reflex acted."""

from __future__ import annotations

import numpy as np

from skillweave.collecting.skill_set import skills_below
from skillweave.skills import Reflex
from skillweave.training.play import Played
from skillweave.training.skill_report import played_below
from skillweave.types import Array, Policy


class ReflexTally:
    """Counts of the steps in which each reflex of a policy acted, at every level.

    Where several reflexes hold, only the one whose action was taken counts: the last of a level,
    and a reflex of a hierarchy before reflexes of the hierarchies in it.

    Args:
        policy: the acting policy.
        path: of its skills: empty, or ``inner/`` for example.
    """

    def __init__(self, policy: Policy, path: str = "") -> None:
        skills = skills_below(policy)
        outer = getattr(policy, "reflexes", ())  # of a skill that acts alone
        self._reflexes: tuple[Reflex, ...] = (
            *(() if skills is None else skills.reflexes),
            *(outer if isinstance(outer, tuple) else ()),
        )
        self._path = path
        self._count = [0] * len(self._reflexes)
        below = {
            i: ReflexTally(inner, f"{path}{policy.labels[i]}/")
            for i, inner in enumerate(() if skills is None else skills.policies)
        }
        self._below = {i: tally for i, tally in below.items() if tally.counts}

    @property
    def counts(self) -> bool:
        """True if this level or one below has a reflex."""
        return bool(self._reflexes or self._below)

    def add(self, played: Played, overridden: Array | None = None) -> None:
        """Count one step of each environment.

        Args:
            overridden: (k,) bool, a reflex of a level above acted.
        """
        if not self.counts:
            return
        acted = np.zeros(len(played.rows), bool) if overridden is None else overridden.copy()
        for i, reflex in reversed(list(enumerate(self._reflexes))):
            acts = reflex.holds(played.step.obs) & ~acted
            self._count[i] += int(acts.sum())
            acted |= acts
        for i, tally in self._below.items():
            rows = np.flatnonzero(played.acting == i)
            if len(rows):
                tally.add(played_below(played, i, rows), acted[rows])

    def steps(self) -> dict[str, int]:
        """Return the steps in which each reflex acted, by its path."""
        steps_of: dict[str, int] = {}
        for reflex, count in zip(self._reflexes, self._count, strict=True):
            name = f"{self._path}{reflex.name}"
            steps_of[name] = steps_of.get(name, 0) + count
        for tally in self._below.values():
            steps_of |= tally.steps()
        return steps_of
