"""The course of ``train`` and ``resume``: check everything, write a run, train it."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from skillweave._internal.messages import absolute, as_path, shown_path
from skillweave._internal.notices import collected_notices, warn
from skillweave._internal.paths import AGENT
from skillweave._internal.seeding import Seeds, global_generators
from skillweave._internal.terminal import steady_streams
from skillweave.api.applying import D, Trained, apply_manifest, differences
from skillweave.api.continuing import continuable_run, continue_run
from skillweave.api.starting import starts
from skillweave.api.train_options import TrainOptions
from skillweave.calls.recorder import check_size
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, Interrupted, RunError
from skillweave.evolution.evolving import check_several, make_learner, plan
from skillweave.extensions import fetch
from skillweave.hierarchy import training
from skillweave.hierarchy.declaration import Declaration, with_roles
from skillweave.hierarchy.roles import Level, roles_of
from skillweave.ops.device import normal_tensors
from skillweave.reporting.progress import Progress
from skillweave.runs.command_words import called_by, resume_words, saved_words
from skillweave.runs.directory import CUTS, First, RunDirectory
from skillweave.runs.files import write_json
from skillweave.runs.hub import must_be_own
from skillweave.runs.initial_policies import (
    Learnt,
    compare_with_given,
    copy_initial_policies,
)
from skillweave.runs.manifest import Manifest, identity
from skillweave.runs.numbered import make_numbered
from skillweave.runs.trackers import Listener, make_trackers
from skillweave.training.callback import TrainCallback
from skillweave.training.plain_agent import Declared
from skillweave.training.role import Role, agent_role
from skillweave.training.stage import (
    assign_workers,
    check_data,
    check_replay,
    check_room,
    check_stages,
    workers_of,
)
from skillweave.workers.cluster import Ray
from skillweave.workers.placement import LOCAL, Placement
from skillweave.workers.start_methods import runs_again, why_no_processes

READING: ContextVar[str | None] = ContextVar("READING", default=None)
"""The Python file that is being read for its declaration; None: none is."""


def _may_train() -> None:
    """Raise a DeclarationError while a Python file is only read for its declaration."""
    if (file := READING.get()) is not None:
        raise DeclarationError(
            f"{file} starts training on import. This command only needs its declaration. Put "
            "what trains inside a block that begins with: if __name__ == '__main__':\nIf a skill "
            "is made of what it trains, train that once in another file, and load it here: "
            "Agent(...).load(directory).as_skill(name)"
        )


def train(declared: D, options: TrainOptions) -> Trained[D]:
    """Check a declaration, start a run or continue the one that is there, and train it."""
    declared.validate()
    flat = options.flat
    note = ""
    evolve = options.evolve
    if flat is not False and options.log_calls is not None:
        raise DeclarationError(
            "flat trains one plain agent, which has no skills to call: leave out log_calls"
        )
    how = declared.train_defaults.given(options)
    by_stage = evolve if isinstance(evolve, Mapping) else {"": evolve}
    if isinstance(declared, Declaration) and flat is False and any(by_stage.values()):
        declared, note = apart_to_evolve(declared)
    content = training.manifest(declared, seed=options.seed, flat=flat, how=how)
    return start_run(declared, content, options, note)


def start_run(
    declared: D,
    content: Manifest,
    options: TrainOptions,
    note: str = "",
    repair: First | None = None,
    done: Mapping[str, Any] | None = None,
) -> Trained[D]:
    """Start the run of a manifest, or continue the one in its directory, and train it.

    Args:
        content: the manifest of a new run, without options of this training alone.
        note: is printed first.
        repair: of a repair, the function that writes what its finished stages have learnt.
        done: as for ``training.train``.
    """
    _may_train()
    # An environment may change the working directory as it is made.
    given = options.run_dir
    place = absolute("." if given is None else as_path(given, "run_dir"))
    content = replace(
        content,
        recipe=content.recipe or declared.recipe,
        seed=options.seed,
        track=tuple(options.track),
    )
    with _training(declared) as stack:
        roles = _plan(declared, content, options)
        if options.resume and (run := continuable_run(place)) is not None:
            stack.callback(run.close)
            declared, note = continue_run(declared, content, run, options.evolve)
            note = "; ".join(filter(None, (note, _other_data(run, options.data))))
            return train_stages(declared, run, options, note)
        start_from = options.start_from
        if start_from is None and content.hierarchy is not None and declared._starts is not None:
            start_from = declared._starts()
        check_data(content.stages, roles, given=options.data is not None)
        data: Any = None
        if options.data is not None:
            data = fetch("begin")(declared, content, roles, options.data)
            named = start_from if isinstance(start_from, Mapping) else {}
            if data.learnt and start_from is not None and named is not start_from:
                raise DeclarationError(
                    "data and start_from are given: name the learners that start from a run, "
                    'start_from={"open": run}; the others begin from the data'
                )
            if data.learnt:
                start_from = {**data.learnt, **named}
            note = "; ".join(filter(None, (note, data.note)))
            if data.steps is not None:
                content = replace(content, data=data.steps.name)
                check_room(content.stages, data.steps.room)
        learnt, origin = starts(content, start_from, roles) if repair is None else ({}, "")
        if content.keep != "last":
            compare_with_given(content.stages)
        first = repair or partial(_first_files, learnt=learnt, data=data)
        note = " ".join(filter(None, (note, origin, _kept_by_populations(content))))
        make_trackers(options.track, None)  # a missing extra is reported before anything is written
        if options.cluster is not None:
            options.cluster.check()
        if given is None:
            stem = _run_name(declared, content) + ("" if repair is None else "-repair")
            place = make_numbered(stem, place)
            note = "; ".join(filter(None, (f"run: {shown_path(place)}", note)))
            stack.callback(_remove_if_empty, place)
        run = RunDirectory.create(place, content, first, hold=True, overwrite=options.overwrite)
        stack.callback(run.close)
        return train_stages(declared, run, options, note, done)


def _other_data(run: RunDirectory, data: Any) -> str:
    """Return a sentence where a run continues with other data than those given; may be empty."""
    kept = run.manifest.data
    given = getattr(getattr(data, "data", data), "name", None)  # a Dataset, or Segments of one
    if data is None or given == kept:
        return ""
    return f"the run continues as it began, {f'with {kept}' if kept else 'without further data'}"


def _first_files(run: RunDirectory, learnt: Mapping[str, Learnt], data: Any) -> None:
    """Write the files that a new run begins with: initial policies, and what is of its data."""
    copy_initial_policies(run, learnt)
    if data is not None and data.steps is not None:
        run.save_data(data.steps.tensors())
    if data is not None and data.cuts is not None:
        write_json(run.path / CUTS, data.cuts)


def _kept_by_populations(content: Manifest) -> str:
    """Return a sentence on the stages in which ``keep="best"`` changes nothing; may be empty."""
    names = [stage.name for stage in content.stages if stage.evolution]
    if content.keep != "best" or not names:
        return ""
    return f"{', '.join(names)}: a population always ends with its best member, whatever keep is."


def _run_name(declared: Declared, content: Manifest) -> str:
    """Return the stem of a numbered directory: of the recipe, the hierarchy or the environment."""
    name = declared.spec.name
    flat = ""
    if isinstance(declared, Declaration):
        flat = "-flat" if content.hierarchy is None else ""
        name = name if declared.name == type(declared).name else declared.name
    return (Path(content.recipe or "").stem or name) + flat


def _remove_if_empty(path: Path) -> None:
    with suppress(OSError):
        path.rmdir()


def existing_run(declared: Declaration, content: Manifest, run_dir: Path) -> RunDirectory | None:
    """Return the run of this manifest in ``run_dir``; None: it is not started.

    Raises:
        RunError: there is a run, but of another manifest.
    """
    if not (run_dir / "run.json").exists():
        return None
    run, content = RunDirectory.open(run_dir), copy.deepcopy(content)
    _plan(declared, content, TrainOptions())
    grown = any(stage.continued for stage in run.manifest.stages)
    if grown or run.manifest.id != identity(content):
        raise RunError(
            f"{run_dir} holds a run of other settings (or of another recipe, budget or version); "
            "choose another directory"
        )
    return run


@global_generators(Seeds(0) / "plan")  # environments are made, and timed
def _plan(declared: Declared, content: Manifest, options: TrainOptions) -> Mapping[str, Role]:
    """Check a training's arguments, and complete its manifest's stages; return the roles."""
    stages = [stage for stage in content.stages if not stage.done]
    spec, cluster = declared.spec, options.cluster
    declared.check_spaces()
    plan(stages, options.evolve)
    check_several(stages, spec)
    check_stages(stages, content.eval_every, content.keep)
    if steps := content.log_calls:
        if any(stage.evolution for stage in stages):
            raise DeclarationError(
                "log_calls is set, but members of a population have policies of their own, so no "
                "log of calls is kept while they evolve: leave out log_calls or evolve, and record "
                "calls afterwards with run.log_calls()"
            )
        check_size(steps, (spec.spaces.observation, spec.spaces.action))
    if cluster is not None and cluster.collectors is not None:
        spec = replace(spec, workers=cluster.collectors)
    assign_workers(stages, spec, declared)
    if cluster is None and any(stage.workers > 1 for stage in stages):
        _must_not_run_again(spec)
    roles: Mapping[str, Role] = {AGENT: agent_role(declared.spec)}
    if content.hierarchy is not None:
        assert isinstance(declared, Declaration)
        roles = roles_of(declared).by_path
    for stage in stages:
        for path in stage.learns:
            config = stage.algorithms.get(path, stage.algorithm)
            if roles[path].kind != "critic":  # it has no replay
                check_replay(replace(stage, algorithm=config), roles[path])
    return roles


@contextmanager
def _training(declared: Declared) -> Iterator[ExitStack]:
    """Let ``train`` train with steady streams and normal tensors, whatever the program has set.

    Notices wait until the progress prints them.
    """
    with (
        steady_streams(),
        normal_tensors(),
        called_by(declared._caller),
        collected_notices(),
        ExitStack() as stack,
    ):
        yield stack


def _must_not_run_again(spec: EnvSpec) -> None:
    """Raise a DeclarationError where processes would run the program that starts them."""
    if not why_no_processes() and (why := runs_again()):
        raise DeclarationError(
            f"{spec.name} is to be stepped in {spec.workers} processes, but {why}\n"
            "Or have one process: EnvSpec(workers=1)"
        )


def resume(declared: D, options: TrainOptions) -> Trained[D]:
    """Finish a run with its own settings; a message lists those that differ."""
    declared.validate()
    assert options.run_dir is not None
    run = RunDirectory.open(as_path(options.run_dir, "run_dir"))
    applied = apply_manifest(declared, run)
    note = ""
    if not declared.recorded and declared.recipe is None:  # the command line may change a recipe
        flat = run.manifest.hierarchy is None
        note = differences(training.manifest(declared, seed=run.manifest.seed, flat=flat), run)
    return train_stages(applied, run, options, note)


def train_stages(
    declared: D,
    run: RunDirectory,
    options: TrainOptions,
    note: str = "",
    done: Mapping[str, Any] | None = None,
) -> Trained[D]:
    """Train what is left of a run; ``note`` is printed first. ``done``: as of ``start_run``."""
    if not run.finished:
        _may_train()
    must_be_own(run.path)
    with _training(declared) as stack, collected_notices() as notices:
        stack.callback(run.close)
        run.begin()
        progress = stack.enter_context(Progress(quiet=options.quiet))
        progress.plan(run.manifest.stages)
        if note:
            progress.message(note)
        notices.tell_by(warn if options.quiet else progress.message)
        listeners: list[Listener] = [progress]
        for tracker in make_trackers(run.manifest.track, run):
            stack.callback(tracker.close)
            listeners.append(tracker)
        if options.callback is not None:  # last: the report that it receives is written by then
            listeners.append(TrainCallback(options.callback, run))
        make = _where(options.cluster, run, progress, stack)
        learner = make_learner(run.manifest.stages, options.evolve, make)
        try:
            with global_generators(Seeds(run.manifest.seed) / "global"):
                policy = training.train(declared, run, tuple(listeners), learner, done)
        except KeyboardInterrupt:
            raise Interrupted(f"{saved_words(run)}. Continue: {resume_words(run)}") from None
    return declared, run, policy


H = TypeVar("H", bound=Declaration)


def apart_to_evolve(declared: H) -> tuple[H, str]:
    """Return a hierarchy as it can evolve, and a sentence on differences from the declaration.

    Skills and selector cannot evolve together, so where that is declared they learn apart.
    """
    roles = roles_of(declared)
    changed = [
        path
        for path, level in roles.levels.items()
        if level.learn == "together" and roles.learns_together(level)
    ]
    if not changed:
        return declared, ""

    def apart(level: Level) -> Level:
        return replace(level, learn="apart") if level.path in changed else level

    return with_roles(declared, roles.changed(apart)), (
        "Skills and selector cannot evolve together yet, so they learn apart here; "
        "learn='apart' in the declaration ends this message."
    )


def _where(
    cluster: Ray | None, run: RunDirectory, progress: Progress, stack: ExitStack
) -> Placement:
    """Return the placement of a run's collectors, and of parts of its populations.

    A cluster is left when ``stack`` is closed.

    Raises:
        RunError: the run was started with another number of collectors.
    """
    if cluster is None or run.finished:
        return LOCAL
    left = [s for s in run.manifest.stages if not s.done]
    counts = [s.workers for s in left]
    wanted = cluster.collectors
    if wanted is not None and any(s.workers != workers_of(s, wanted) for s in left):
        raise RunError(
            f"{run.path} was started with {', '.join(map(str, sorted(set(counts))))} collectors, "
            f"and continues with as many, as results depend on it; leave out collectors={wanted}"
        )
    alone = [s.name for s in left if s.evolution and s.workers == 1]
    if alone:
        progress.message(
            f"{', '.join(alone)}: the population trains in this process, as no number of "
            "collectors was given: Ray(collectors=4), --collectors 4"
        )
    return stack.enter_context(cluster.connected(max(counts, default=1), progress.message))
