"""The command ``skillweave plan``.

Nothing here imports torch, as help reads it.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from tyro.conf import Positional

from skillweave.cli.commands import Loaded, MaybeOut


@dataclass(frozen=True)
class PlanCommand(Loaded):
    """Plan a new mission on a run's recorded calls, and score it; nothing is trained."""

    target: Positional[str] = tyro.MISSING
    """A run's directory, or with --pretrained a recipe's name."""
    mission: Positional[str] = tyro.MISSING
    """Such as "left then hover for 100 steps, avoid crash". A skill's name means its success; a
    recipe may declare more words: Hierarchy(predicates=...)."""
    steps: int = 20_000
    """Environment steps to record first, if there is no log of calls."""
    episodes: int = 20
    """Whole episodes to score it in."""
    film: MaybeOut = None
    """A .gif or .mp4 file to write."""
    seed: int = 0
    """Picks the episodes."""


PLAN = PlanCommand, "skillweave.planning.plan_command:plan"
