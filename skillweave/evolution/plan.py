"""Which phases of a run evolve, and how that is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skillweave.algorithms.config import config_from_json
from skillweave.algorithms.policy import AgentPolicy
from skillweave.evolution.config import Evolution, evolution_to_json
from skillweave.evolution.mutation import check_mutations
from skillweave.evolution.phase import evolve_phase
from skillweave.messages import short
from skillweave.runs.directory import RunDirectory
from skillweave.seeding import Seeds
from skillweave.training.phase import Listener, Phase, Trainer
from skillweave.types import SkillweaveError

Evolve = Evolution | Mapping[str, Evolution | None] | None
"""A population for every phase, or for those named."""


def plan(phases: list[dict[str, Any]], evolve: Evolve) -> None:
    """Say in a manifest's phases which are to evolve, and count all members' steps.

    Raises:
        SkillweaveError: no such phase, or a mutation does not fit an agent.
    """
    for name, how in _by_phase([p["name"] for p in phases], evolve).items():
        entry = next(p for p in phases if p["name"] == name)
        check_mutations(config_from_json(entry["algorithm"]), how, f"phase {name!r}: ")
        entry["evolution"] = evolution_to_json(how)
        entry["budget"] *= how.population


def trainer(run: RunDirectory, evolve: Evolve) -> Trainer:
    """Trains a phase as the run says; ``evolve`` holds selections of the user's own, if any."""
    asked = _by_phase([p["name"] for p in run.manifest["phases"]], evolve)

    def train(
        phase: Phase, run: RunDirectory, seeds: Seeds, listeners: tuple[Listener, ...]
    ) -> AgentPolicy:
        selection = asked[phase.name].selection if phase.name in asked else None
        return evolve_phase(phase, run, seeds, listeners, selection)

    return train


def _by_phase(phases: list[str], evolve: Evolve) -> dict[str, Evolution]:
    """The phases that are to evolve."""
    if evolve is None:
        return {}
    if isinstance(evolve, Evolution):
        return dict.fromkeys(phases, evolve)
    if not isinstance(evolve, Mapping):
        raise SkillweaveError(
            f"evolve is {short(evolve)}; it must be an Evolution(), or one for each phase by name"
        )
    for name, how in evolve.items():
        if name not in phases:
            known = ", ".join(phases)
            raise SkillweaveError(f"evolve: no phase {short(name)} is trained; there are: {known}")
        if not isinstance(how, Evolution | None):
            raise SkillweaveError(
                f"evolve[{name!r}] is {short(how)}; it must be an Evolution() or None"
            )
    return {name: how for name, how in evolve.items() if how is not None}
