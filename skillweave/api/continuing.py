"""Continue the run in a directory, perhaps for more steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from skillweave._internal.paths import decides, is_below, level_of
from skillweave.algorithms.config import config_from_json, is_offline
from skillweave.api.applying import D, apply_manifest, differences
from skillweave.errors import RunError
from skillweave.evolution.evolving import Evolve, plan
from skillweave.runs.command_words import from_command_line, start_words
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import is_copy_of_hub
from skillweave.runs.manifest import Manifest, StageEntry

EVALUATIONS = "evaluation*.json"
"""Saved evaluations of a run, which are of the policy before it continued."""


def continuable_run(path: Path) -> RunDirectory | None:
    """Return the run in a directory; None: there is none, or it has learnt nothing so far."""
    if not (path / "run.json").exists():
        return None
    run = RunDirectory.open(path)
    return run if run.finished or run.has_learnt else None


def continue_run(
    declared: D,
    content: Manifest,
    run: RunDirectory,
    evolve: Evolve,
) -> tuple[D, str]:
    """Return a declaration with a run's manifest applied, and sentences; the run is locked.

    Stages whose budgets have grown get the new ones.

    Args:
        content: the manifest that a new run of the declaration would have.

    Raises:
        RunError: the run is one of another declaration, or a stage cannot continue.
    """
    declared = apply_manifest(declared, run)
    _check_same(content, run)
    stages = content.stages
    if run.manifest.hierarchy is not None:
        # As the run learns, apart or together: it may be declared otherwise now.
        stages = [stage.entry() for stage in declared.stages()]
    budgets = _budgets(stages, run, evolve)
    sentences = [] if declared.recorded else [differences(content, run, budgets=False)]
    if content.track != run.manifest.track:
        known = ", ".join(run.manifest.track) or "none"
        sentences.append(f"the run continues with its own trackers: {known}")
    if content.log_calls != (steps := run.manifest.log_calls):
        log = "no log of calls" if steps is None else f"log_calls={steps:,}"
        sentences.append(f"the run continues as it began, with {log}")
    if not run.finished or max(_more(run.manifest.stages, budgets).values()) > 0:
        run.begin(finished=True)
        run.manifest.code |= content.code  # as it goes on
    sentences += _grow(run, budgets)
    if run.finished and not any(entry.reached for entry in run.manifest.stages):
        more = "--set steps=N, or --scale" if from_command_line() else "more steps"
        sentences.append(
            f"{run.path} is finished, so nothing is trained; to train it for longer, give it {more}"
        )
    return declared, "; ".join(filter(None, sentences))


def _check_same(content: Manifest, run: RunDirectory) -> None:
    """Raise a RunError where a run is of another kind, recipe or seed than a manifest."""
    manifest = run.manifest
    if content.kind != manifest.kind:
        flat = "--flat" if from_command_line() else "flat=True"
        one = f"a flat agent ({flat})"
        other = "a hierarchy"
        if manifest.hierarchy is not None:
            one, other = other, one
        raise RunError(
            f"{run.path} is the run of {one}, but it was to continue as {other}; choose another "
            "directory"
        )
    mine, theirs = content.recipe, manifest.recipe
    if mine and theirs and Path(mine).name != Path(theirs).name:
        raise RunError(
            f"{run.path} is a run of the recipe {theirs}, not of {mine}; choose another directory"
        )
    if content.seed != manifest.seed:
        raise RunError(
            f"{run.path} was trained with seed {manifest.seed}, not {content.seed}; give that "
            "seed, or choose another directory"
        )


def _budgets(stages: list[StageEntry], run: RunDirectory, evolve: Evolve) -> dict[str, int]:
    """Return the budgets of a run's stages as they are declared now, where both have the stage.

    Args:
        stages: the entries of the stages that are declared now.
    """
    if run.manifest.hierarchy is not None:
        names = {stage.name for stage in stages}
        if not isinstance(evolve, Mapping) or set(evolve) <= names:
            plan(stages, evolve)
    theirs = {entry.name: entry for entry in run.manifest.stages}
    budgets = {}
    for stage in stages:
        if (entry := theirs.get(stage.name)) is not None:
            # A population's budget is that of all members.
            budgets[stage.name] = stage.budget // stage.members * entry.members
    return budgets


def _more(stages: Sequence[StageEntry], budgets: Mapping[str, int]) -> dict[str, int]:
    """Return by stage the steps that its budget has grown by."""
    more: dict[str, int] = {}
    for entry in stages:
        heir = _heir(stages, entry).name
        declared = budgets.get(entry.name, entry.budget)
        more[heir] = more.get(heir, 0) + declared - entry.budget
    return more


def _grow(run: RunDirectory, budgets: Mapping[str, int]) -> list[str]:
    """Give stages of a run more steps, and write that; return sentences about it.

    A stage whose learners learn again in a later one stays as it is, as the later one would not
    start from the new weights. The later one gets its steps, too.
    """
    stages = run.manifest.stages
    more = _more(stages, budgets)
    finished = run.finished
    grown = list[StageEntry]()
    sentences = list[str]()
    for entry in stages:
        name, budget = entry.name, entry.budget
        wanted = budget + more.get(name, 0)
        if wanted < budget:
            sentences.append(f"{name} keeps its {budget:,} steps (declared now: {wanted:,})")
        elif wanted > budget and entry.reached:
            sentences.append(f"{name} has reached its target, so it gets no more steps")
        elif wanted > budget and entry.done and not finished:
            sentences.append(f"{name} can be given more steps once the run is finished")
        elif wanted > budget:
            had = entry.extended or budget
            sentences.append(f"{name} continues: {had:,} -> {had + wanted - budget:,} steps")
            grown.append(entry)
    for entry in grown:
        _check_grows(run, entry, more[entry.name])
    for entry in grown:
        if entry.extended is not None:  # the new steps come after those that it had
            entry.budget, entry.extended = entry.extended, None
        entry.budget += more[entry.name]
        if entry.done:
            entry.careful = _became_better(run, entry)
            entry.continued = [*entry.continued, entry.steps or 0]
            entry.forget_end()
    if grown:
        run.save()
        for path in run.path.glob(EVALUATIONS):
            path.unlink()
    return sentences + _stale(stages, grown)


def _became_better(run: RunDirectory, entry: StageEntry) -> bool:
    """Return whether the latest evaluation of a stage was better than its first one.

    False where there are none, or their file is damaged.
    """
    if run.manifest.eval_every is None:
        return False
    try:
        lines = [line for line in run.metrics() if line.get("stage") == entry.name]
    except RunError:
        return False
    returns = [line["eval_return"] for line in lines if "eval_return" in line]
    return len(returns) > 1 and returns[-1] > returns[0]


def _heir(stages: Sequence[StageEntry], entry: StageEntry) -> StageEntry:
    """Return the latest stage with a learner of this one."""
    learners = set(entry.learns)
    return next(other for other in reversed(stages) if learners & set(other.learns))


def _check_grows(run: RunDirectory, entry: StageEntry, more: int) -> None:
    """Raise a RunError where a stage cannot be given more steps."""
    name = entry.name
    new = f"Start a new run from what it has learnt: {start_words(run)}"
    if entry.evolution:
        raise RunError(
            f"{run.path}: stage {name!r} is a population, which cannot be given more steps, as "
            f"only its best member is kept. {new}"
        )
    if not entry.done:
        return
    if is_copy_of_hub(run.path) or not run.file("final", name).exists():
        raise RunError(
            f"{run.path} cannot be given more steps: it does not hold the final state of stage "
            f"{name!r} (a copy from the hub does not, nor does a run whose disk was full). {new}"
        )
    tensors = run.final_tensors(name)
    left = (entry.extended or entry.budget) + more - (entry.steps or 0)
    for learner, config in _algorithms(entry).items():
        waits = config.get("learning_starts", 0)
        place = "learner." + (f"{learner}." if entry.together else "") + "store."
        if is_offline(config_from_json(config)):
            continue  # it waits for nothing
        if left <= waits and not any(tensor.startswith(place) for tensor in tensors):
            raise RunError(
                f"{run.path}: {learner!r} would learn nothing in {left:,} more steps, as its "
                f"replay buffer is not kept and the first {waits:,} (learning_starts) fill a new "
                "one; give more steps"
            )


def _algorithms(entry: StageEntry) -> dict[str, dict[str, Any]]:
    """Return the settings of a stage's learners, by name."""
    first = entry.decides if entry.together else entry.name
    return ({first: entry.algorithm} if first in entry.learns else {}) | entry.algorithms


def _stale(stages: Sequence[StageEntry], grown: Sequence[StageEntry]) -> list[str]:
    """Return a sentence on each selector that stays as it is while its skills continue."""
    sentences = []
    for at, entry in enumerate(stages):
        level = level_of(entry.name)
        if not entry.done or entry in grown or not decides(str(entry.decides)):
            continue
        skills = [
            name
            for other in stages[:at]
            if other in grown
            for name in other.learns
            if is_below(name, level)
        ]
        if skills:
            sentences.append(
                f"{entry.name} stays as it is, so it still chooses for {', '.join(skills)} as "
                "they were; give it more steps, too"
            )
    return sentences
