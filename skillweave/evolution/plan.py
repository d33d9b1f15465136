"""Which stages of a run evolve, and how that is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any

from skillweave.algorithms.config import config_from_json
from skillweave.collecting.where import HERE, Where
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.evolution.config import Evolution, evolution_to_json
from skillweave.evolution.mutation import check_mutations
from skillweave.evolution.part import too_many
from skillweave.evolution.stage import EvolvingPopulation
from skillweave.messages import short
from skillweave.training.stage_run import MakeLearner, StageLearner, StageRun
from skillweave.training.woven import agents_of

Evolve = Evolution | Mapping[str, Evolution | None] | None
"""A population for every stage, or for those named."""


def plan(stages: list[dict[str, Any]], evolve: Evolve) -> None:
    """Say in a manifest's stages which are to evolve, and count all members' steps.

    Raises:
        DeclarationError: no such stage, or a mutation does not fit an agent.
    """
    for name, how in _by_stage([p["name"] for p in stages], evolve).items():
        entry = next(p for p in stages if p["name"] == name)
        if "together" in entry:
            raise DeclarationError(
                f"stage {name!r}: {' and '.join(entry['learns'])} learn together there, so it "
                "cannot evolve; name the stages that are to: evolve={'a_skill': Evolution(...)}"
            )
        if "guide_kl" in entry:
            raise DeclarationError(
                f"stage {name!r}: the guide has a target_kl, and populations are not kept near a "
                "guide; leave it out (restrict=True works), or name other stages: evolve={...}"
            )
        check_mutations(config_from_json(entry["algorithm"]), how, f"stage {name!r}: ")
        entry["evolution"] = evolution_to_json(how)
        if how.target is not None:
            entry["target"] = {"of": "return", "at_least": how.target}
        entry["budget"] *= how.population


def check_several(stages: Sequence[Mapping[str, Any]], spec: EnvSpec) -> None:
    """Raise an EnvError where a stage evolves, and there cannot be two environments at once.

    Stages before it would be trained in vain.
    """
    evolving = [entry for entry in stages if entry.get("evolution")]
    if not evolving:
        return
    needed = max(e["evolution"]["population"] * e["algorithm"]["num_envs"] for e in evolving)
    with closing(spec.make()):
        try:
            spec.make(number=1).close()
        except SkillweaveError as error:
            raise too_many(error, f"{needed} of them to train in") from error


def make_learner(stages: list[dict[str, Any]], evolve: Evolve, where: Where = HERE) -> MakeLearner:
    """Who learns in a stage: a population where its entry says so, else one agent.

    ``evolve`` holds selections of the user's own, which a run knows by name only.
    ``where`` collectors run, and parts of populations.

    Raises:
        DeclarationError: ``evolve`` names a stage that is not among ``stages``.
    """
    asked = _by_stage([s["name"] for s in stages], evolve)

    def make(stage: StageRun) -> StageLearner:
        if stage.entry.get("evolution") is None:
            return agents_of(stage, where.collectors)
        how = asked.get(stage.name)
        return EvolvingPopulation(stage, None if how is None else how.selection, where)

    return make


def _by_stage(stages: list[str], evolve: Evolve) -> dict[str, Evolution]:
    """Return the stages that are to evolve."""
    if evolve is None:
        return {}
    if isinstance(evolve, Evolution):
        return dict.fromkeys(stages, evolve)
    if not isinstance(evolve, Mapping):
        raise DeclarationError(
            f"evolve is {short(evolve)}; it must be an Evolution(), or one for each stage by name"
        )
    for name, how in evolve.items():
        if name not in stages:
            known = ", ".join(stages)
            raise DeclarationError(f"evolve: no stage {short(name)} is trained; there are: {known}")
        if not isinstance(how, Evolution | None):
            raise DeclarationError(
                f"evolve[{name!r}] is {short(how)}; it must be an Evolution() or None"
            )
    return {name: how for name, how in evolve.items() if how is not None}
