"""The argument ``evolve``: the stages of a run that evolve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing

from skillweave._internal.messages import short, suggest
from skillweave.algorithms.config import config_from_json
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.evolution.config import Evolution, evolution_to_json
from skillweave.evolution.generations import EvolvingPopulation
from skillweave.evolution.mutation import check_mutations
from skillweave.evolution.shard import too_many
from skillweave.runs.manifest import StageEntry, Target
from skillweave.schema import fitted
from skillweave.training.agents import Agents
from skillweave.training.stage_run import MakeLearner, StageLearner, StageRun
from skillweave.workers.placement import LOCAL, Placement

Evolve = Evolution | Mapping[str, Evolution | None] | None
"""A population for every stage, or for the named ones."""


def plan(stages: list[StageEntry], evolve: Evolve) -> None:
    """Record in a manifest's stages which ones evolve, and count all members' steps.

    Raises:
        DeclarationError: a stage does not exist, or a mutation does not fit an agent.
    """
    for name, how in _by_stage([p.name for p in stages], evolve).items():
        entry = next(p for p in stages if p.name == name)
        if entry.together:
            raise DeclarationError(
                f"stage {name!r}: {' and '.join(entry.learns)} learn together there, so it "
                "cannot evolve; name the stages that should: evolve={'a_skill': Evolution(...)}"
            )
        if entry.guide_kl is not None:
            raise DeclarationError(
                f"stage {name!r}: the guide has a target_kl, and populations are not kept near a "
                "guide; omit it (restrict=True works), or name other stages: evolve={...}"
            )
        check_mutations(config_from_json(entry.algorithm), how, f"stage {name!r}: ")
        entry.evolution = evolution_to_json(how)
        if how.target is not None:
            entry.target = Target("return", how.target)
        entry.budget *= how.population


def check_several(stages: Sequence[StageEntry], spec: EnvSpec) -> None:
    """Raise an EnvError where a stage evolves, but two environments cannot exist at once.

    Otherwise the stages before it would be trained for nothing.
    """
    evolving = [entry for entry in stages if entry.evolution]
    if not evolving:
        return
    needed = max(e.members * e.num_envs for e in evolving)
    with closing(spec.make()):
        try:
            spec.make(number=1).close()
        except SkillweaveError as error:
            raise too_many(error, f"{needed} of them to train in") from error


def make_learner(stages: list[StageEntry], evolve: Evolve, where: Placement = LOCAL) -> MakeLearner:
    """Return a function that makes a stage's learner: a population, or one agent.

    ``evolve`` has selections of the user, of which a run records only names. ``where`` is the
    placement of collectors and parts of populations.

    Raises:
        DeclarationError: ``evolve`` names a stage that is not among ``stages``.
    """
    by_stage = _by_stage([s.name for s in stages], evolve)

    def make(stage: StageRun) -> StageLearner:
        if stage.entry.evolution is None:
            return Agents(stage, where.collectors)
        how = by_stage.get(stage.entry.name)
        return EvolvingPopulation(stage, None if how is None else how.selection, where)

    return make


def _by_stage(stages: list[str], evolve: Evolve) -> dict[str, Evolution]:
    """Return the stages that evolve."""
    evolve = fitted(Evolve, evolve, "evolve")
    if evolve is None:
        return {}
    if isinstance(evolve, Evolution):
        return dict.fromkeys(stages, evolve)
    for name in evolve:
        if name not in stages:
            end = suggest(name, stages)
            raise DeclarationError(f"evolve: no stage {short(name)} is trained{end}")
    return {name: how for name, how in evolve.items() if how is not None}
