"""The course of ``train`` and ``resume``: check everything, write a run, train it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from skillweave.api.applying import Trained
from skillweave.api.continuing import prepared, to_continue
from skillweave.api.starting import Directories, starts
from skillweave.collecting.cluster import Ray
from skillweave.collecting.placement import LOCAL, Placement
from skillweave.collecting.start_methods import runs_again, why_no_processes
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, Interrupted, RunError
from skillweave.evolution.plan import Evolve, check_several, make_learner, plan
from skillweave.hierarchy import training
from skillweave.hierarchy.declaration import Declaration, with_roles
from skillweave.hierarchy.roles import Level, roles_of
from skillweave.messages import absolute, as_path, short, shown_path
from skillweave.notices import collected_notices, warn
from skillweave.ops.device import normal_tensors
from skillweave.paths import AGENT
from skillweave.planning.recorder import check_size
from skillweave.reporting.progress import Progress
from skillweave.runs.command_words import called_by, resume_words, saved_words
from skillweave.runs.directory import First, RunDirectory
from skillweave.runs.hub import must_be_own
from skillweave.runs.initial_policies import copy_initial_policies
from skillweave.runs.manifest import identity
from skillweave.runs.numbered import make_numbered
from skillweave.runs.trackers import make_trackers
from skillweave.seeding import Seeds, global_generators
from skillweave.terminal import steady_streams
from skillweave.training.callback import Callback, TrainCallback, check_callback
from skillweave.training.plain_agent import PlainAgent
from skillweave.training.role import Role, agent_role
from skillweave.training.stage import assign_workers, check_replay, check_stages, workers_of
from skillweave.training.stage_log import Listener

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


D = TypeVar("D", bound=Declaration | PlainAgent)


def begin(
    declared: D,
    content: dict[str, Any],
    run_dir: str | Path | None,
    quiet: bool,
    track: Sequence[str],
    evolve: Evolve,
    cluster: Ray | None,
    start_from: Directories = None,
    note: str = "",
    callback: Callback | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    base: Base | None = None,
    done: Mapping[str, Any] | None = None,
    own_start: Callable[[], Directories] | None = None,
) -> Trained[D]:
    """Check everything, start a run of this manifest, and train it; ``note`` is printed first.

    With ``resume``, continue what is in ``run_dir`` instead, if there is something; with
    ``overwrite``, replace it. With ``base``, the stages of the manifest come after stages that are
    done. ``done``: as for ``training.train``.
    ``own_start`` makes what a new run starts from where ``start_from`` names nothing.
    """
    _may_train()
    check_callback(callback)
    # An environment may change the working directory as it is made.
    place = absolute("." if run_dir is None else as_path(run_dir, "run_dir"))
    run_dir = None if run_dir is None else place
    for word, value in (("resume", resume), ("overwrite", overwrite)):
        if not isinstance(value, bool):
            raise DeclarationError(f"{word} is {short(value)}; it must be True or False")
        if value and run_dir is None:
            raise DeclarationError(
                f'{word}=True needs a run: name its directory, train("runs/a", {word}=True)'
            )
    if resume and overwrite:
        raise DeclarationError(
            "resume continues the run in run_dir, and overwrite replaces it: leave out one of them"
        )
    if not isinstance(track, Sequence):
        raise DeclarationError(f"track is {short(track)}; it must be a list: track=['wandb']")
    track = (track,) if isinstance(track, str) else tuple(track)
    with _surroundings(), called_by(declared._caller), ExitStack() as stack:
        stack.enter_context(collected_notices())  # the progress prints them later
        roles = _plan(declared, content, evolve, cluster)
        if resume and run_dir is not None and (run := to_continue(run_dir)) is not None:
            declared, sentences = prepared(declared, content, run, evolve, track)
            stack.callback(run.close)
            return go_on(declared, run, quiet, evolve, cluster, sentences, callback)
        if start_from is None and own_start is not None:
            start_from = own_start()
        learnt, origin = starts(content, start_from, roles)
        first: First = partial(copy_initial_policies, learnt=learnt)
        note = " ".join(filter(None, (note, origin, _kept_by_populations(content))))
        make_trackers(track, None)  # a missing extra is reported before anything is written
        if cluster is not None:
            cluster.check()
        content = content | {"track": track}
        if run_dir is None:
            name, flat = declared.spec.name, False
            if isinstance(declared, Declaration):
                flat = content["kind"] == "agent"
                name = name if declared.name == Declaration.name else declared.name
            stem = _run_name(content.get("recipe"), name, flat)
            stem += "" if base is None else f"-{base.name}"
            run_dir = make_numbered(stem, place)
            note = "; ".join(filter(None, (f"run: {shown_path(run_dir)}", note)))
            stack.callback(_remove_if_empty, run_dir)
        if base is not None:
            content["stages"] = [*base.stages, *content["stages"]]
            first = base.write
        run = RunDirectory.create(run_dir, content, first, hold=True, overwrite=overwrite)
        stack.callback(run.close)
        return go_on(declared, run, quiet, evolve, cluster, note, callback, done)


@dataclass(frozen=True)
class Base:
    """Finished stages with which a new run begins."""

    stages: Sequence[dict[str, Any]]
    """Their entries."""
    write: First
    """Writes their policies into the run."""
    name: str
    """The word at the end of a numbered directory's name."""


def _kept_by_populations(content: dict[str, Any]) -> str:
    """Return a sentence on the stages in which ``keep="best"`` changes nothing; may be empty."""
    names = [stage["name"] for stage in content["stages"] if stage.get("evolution")]
    if content["keep"] != "best" or not names:
        return ""
    return f"{', '.join(names)}: a population always ends with its best member, whatever keep is."


def _run_name(recipe: str | None, name: str, flat: bool) -> str:
    """Return the stem of a numbered directory.

    Args:
        recipe: the declaration's place; its name comes first.
        name: of the hierarchy, or of the environment.
        flat: the flat baseline of a hierarchy is trained.
    """
    stem = "" if recipe is None else Path(recipe).stem
    return (stem or name) + ("-flat" if flat else "")


def _remove_if_empty(path: Path) -> None:
    with suppress(OSError):
        path.rmdir()


def begun(declared: Declaration, content: dict[str, Any], run_dir: Path) -> RunDirectory | None:
    """Return the run of this manifest in ``run_dir``; None: it is not started.

    Raises:
        RunError: there is a run, but of another manifest.
    """
    if not (run_dir / "run.json").exists():
        return None
    run, content = RunDirectory.open(run_dir), copy.deepcopy(content)
    _plan(declared, content, None, None)
    grown = any(stage.get("continued") for stage in run.manifest["stages"])
    if grown or run.manifest.get("id") != identity(content):
        raise RunError(
            f"{run_dir} holds a run of other settings (or of another recipe, budget or version); "
            "choose another directory"
        )
    return run


@global_generators(Seeds(0) / "plan")  # environments are made, and timed
def _plan(
    declared: Declaration | PlainAgent, content: dict[str, Any], evolve: Evolve, cluster: Ray | None
) -> Mapping[str, Role]:
    """Check everything, and complete the entries of a manifest's stages; return the roles."""
    declared.check_spaces()
    plan(content["stages"], evolve)
    check_several(content["stages"], declared.spec)
    check_stages(content["stages"], content["eval_every"], content["keep"])
    if content.get("log_calls") and any(s.get("evolution") for s in content["stages"]):
        raise DeclarationError(
            "log_calls is set, but members of a population have policies of their own, so no log "
            "of calls is kept while they evolve: leave out log_calls or evolve, and record calls "
            "afterwards with run.log_calls()"
        )
    spec = declared.spec
    if steps := content.get("log_calls"):
        check_size(steps, (spec.spaces.observation, spec.spaces.action))
    _check(cluster)
    if cluster is not None and cluster.collectors is not None:
        spec = replace(spec, workers=cluster.collectors)
    assign_workers(content["stages"], spec, declared)
    if cluster is None and any(stage["workers"] > 1 for stage in content["stages"]):
        _must_not_run_again(spec)
    roles: Mapping[str, Role] = {AGENT: agent_role(declared.spec)}
    if content["kind"] == "hierarchy":
        assert isinstance(declared, Declaration)
        roles = roles_of(declared).by_path
    for stage in content["stages"]:
        for path in stage["learns"]:
            config = stage.get("algorithms", {}).get(path, stage["algorithm"])
            if roles[path].kind != "critic":  # it has no replay
                check_replay(stage | {"algorithm": config}, roles[path])
    return roles


@contextmanager
def _surroundings() -> Iterator[None]:
    """Train with steady streams and normal tensors, whatever the user's program has set."""
    with steady_streams(), normal_tensors():
        yield


def _must_not_run_again(spec: EnvSpec) -> None:
    """Raise a DeclarationError where processes would run the program that starts them."""
    if not why_no_processes() and (why := runs_again()):
        raise DeclarationError(
            f"{spec.name} is to be stepped in {spec.workers} processes, but {why}\n"
            "Or have one process: EnvSpec(workers=1)"
        )


def go_on(
    declared: D,
    run: RunDirectory,
    quiet: bool,
    evolve: Evolve,
    cluster: Ray | None,
    note: str = "",
    callback: Callback | None = None,
    done: Mapping[str, Any] | None = None,
) -> Trained[D]:
    """Train what is left of a run; ``note`` is printed first. ``done``: as of ``begin``."""
    check_callback(callback)
    if not run.finished:
        _may_train()
    must_be_own(run.path)
    with _surroundings(), ExitStack() as stack:
        stack.enter_context(called_by(declared._caller))
        stack.callback(run.close)
        run.begin()
        notices = stack.enter_context(collected_notices())
        progress = stack.enter_context(Progress(quiet=quiet))
        progress.plan(run.manifest["stages"])
        if note:
            progress.message(note)
        notices.tell_by(warn if quiet else progress.message)
        trackers = make_trackers(run.manifest.get("track", ()), run)
        for tracker in trackers:
            stack.callback(tracker.close)
        listeners: tuple[Listener, ...] = (progress, *trackers)
        if callback is not None:  # last: the report that it receives is written by then
            listeners = (*listeners, TrainCallback(callback, run))
        make = _where(cluster, run, progress, stack)
        learner = make_learner(run.manifest["stages"], evolve, make)
        try:
            with global_generators(Seeds(int(run.manifest["seed"])) / "global"):
                policy = training.train(declared, run, listeners, learner, done)
        except KeyboardInterrupt:
            raise Interrupted(f"{saved_words(run)}. Continue: {resume_words(run)}") from None
    return declared, run, policy


H = TypeVar("H", bound=Declaration)


def evolving(declared: H, evolve: Evolve) -> tuple[H, str]:
    """Return the hierarchy as it can evolve, and a sentence on differences from the declaration.

    Skills and selector cannot evolve together, so where that is declared they learn apart.
    """
    by_stage = evolve if isinstance(evolve, Mapping) else {"": evolve}
    if all(evolution is None for evolution in by_stage.values()):
        return declared, ""
    return apart_to_evolve(declared)


def apart_to_evolve(declared: H) -> tuple[H, str]:
    """Return a copy of a hierarchy that learns apart, and a sentence about it."""
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
    _check(cluster)
    if cluster is None or run.finished:
        return LOCAL
    left = [s for s in run.manifest["stages"] if s["status"] != "done"]
    counts = [s.get("workers", 1) for s in left]
    wanted = cluster.collectors
    if wanted is not None and any(s.get("workers", 1) != workers_of(s, wanted) for s in left):
        raise RunError(
            f"{run.path} was started with {', '.join(map(str, sorted(set(counts))))} collectors, "
            f"and continues with as many, as results depend on it; leave out collectors={wanted}"
        )
    alone = [s["name"] for s in left if s.get("evolution") and s.get("workers", 1) == 1]
    if alone:
        progress.message(
            f"{', '.join(alone)}: the population trains in this process, as no number of "
            "collectors was given: Ray(collectors=4), --collectors 4"
        )
    return stack.enter_context(cluster.connected(max(counts, default=1), progress.message))


def _check(cluster: Any) -> None:
    if not isinstance(cluster, Ray | None):
        raise DeclarationError(f"cluster is {short(cluster)}; write cluster=Ray(collectors=8)")
