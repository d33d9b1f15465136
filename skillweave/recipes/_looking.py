"""A scripted policy that explores rooms until it sees a task."""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave import Step
from skillweave.recipes._rooms import ACTIONS, FORWARD, LEFT, RIGHT, SPACE, ahead, free
from skillweave.types import Array

Memory = dict[str, Array]
TURNS = 4
"""It sees all four sides and keeps its direction; with one turn less it would walk in squares."""
PACES = 5
"""Steps after which it looks around again."""
ENTERING = 3
"""Steps before it first looks around: from a doorway it would not see much."""


class LookAround:
    """A policy that walks straight for some cells, looks to all four sides, and repeats that.

    Its memory counts turns, and steps since the last one, because an observation shows only the
    cells in front of the agent.
    """

    observation_space = SPACE
    action_space = ACTIONS
    labels: tuple[str, ...] = ()

    def start(self, n: int) -> Memory:
        """Start a memory: it goes some cells before it looks."""
        return {"turns": np.full(n, TURNS), "paces": np.full(n, PACES - ENTERING)}

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return turns to the right, once around; then steps straight on, around obstacles."""
        turns = memory["turns"]
        paces = memory["paces"]
        again = (paces >= PACES) | ((paces > 0) & ~free(ahead(obs)))
        turns = np.where(again, 0, turns)
        paces = np.where(again, 0, paces)
        looks = turns < TURNS
        goes = free(ahead(obs))
        only_left = free(obs[:, 2, 6]) & ~free(obs[:, 4, 6])
        around = np.where(goes, FORWARD, np.where(only_left, LEFT, RIGHT))
        after = {"turns": turns + looks, "paces": paces + (~looks & goes)}
        return np.where(looks, RIGHT, around), after

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the memory unchanged: ``act`` has updated it."""
        return memory

    def acting(self, memory: Memory) -> Any:
        """Return no skill: it has none."""
        return None
