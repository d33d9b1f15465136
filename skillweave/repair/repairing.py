"""The course of ``Run.repair``: measure a handover, train on, measure again, keep the better."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from skillweave._internal.messages import as_path, short, shown_path
from skillweave._internal.paths import join, level_of, name_of
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.config import OnPolicy, alone, config_to_json, with_networks
from skillweave.api import Hierarchy, Run, run_of
from skillweave.api.applying import Trained, apply_manifest
from skillweave.api.running import start_run, train_stages
from skillweave.api.train_options import TrainOptions
from skillweave.calls.log import lacking_features
from skillweave.errors import DeclarationError, RunError
from skillweave.hierarchy import training
from skillweave.hierarchy.assembly import parts_of
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import Roles, roles_of
from skillweave.policies.untrusted import read_file
from skillweave.repair.repair_stage import (
    FEWEST,
    Measured,
    matrix_to_json,
    measure,
    rehearsed_obs,
)
from skillweave.reporting.progress import Progress
from skillweave.runs.directory import RunDirectory
from skillweave.runs.initial_policies import copy_file, file_path
from skillweave.runs.manifest import Manifest, RepairEntry, StageEntry
from skillweave.schema import AtLeastOne, Count, fitted
from skillweave.skills.learnable import learn_on
from skillweave.training.callback import Callback, check_callback
from skillweave.training.rehearsal import can_rehearse, save_rehearsal
from skillweave.training.stage import check_stages

USUAL_STEPS = 200_000
"""Steps of a repair for which none are given."""
GOOD = 0.95
"""A handover that is done at least this often needs no repair."""


@dataclass(frozen=True)
class RepairOptions:
    """Arguments of ``Run.repair``, which describes them.

    Raises:
        DeclarationError: one of them is wrong.
    """

    skill: str
    after: str
    steps: int | None = None
    run_dir: str | Path | None = None
    done: Mapping[str, Any] | None = None
    calls: int = 200
    seed: int = 0
    resume: bool = False
    quiet: bool = False
    callback: Callback | None = None

    def __post_init__(self) -> None:
        check_callback(self.callback)
        for name, kind in (("steps", AtLeastOne | None), ("calls", AtLeastOne), ("seed", Count)):
            object.__setattr__(self, name, fitted(kind, getattr(self, name), name))

    @property
    def training(self) -> TrainOptions:
        """The options of the training in it."""
        return TrainOptions(self.run_dir, seed=self.seed, quiet=self.quiet, callback=self.callback)


def repair(run: Run, **arguments: Any) -> Run:
    """Repair a skill of a run in a new run; the arguments are those of ``Run.repair``."""
    declared = run.hierarchy
    assert isinstance(run.policy, HierarchyPolicy)
    return run_of(_repaired(declared, run.path, run.policy, RepairOptions(**arguments)))


def _repaired(
    declared: Hierarchy, source: Path, policy: HierarchyPolicy, options: RepairOptions
) -> Trained[Hierarchy]:
    """Repair a skill in a new run.

    Args:
        source: the directory of the run, or its weights file.
        policy: of the run.
    """
    roles = roles_of(declared)
    skill, after = _checked(roles, options.skill, options.after)
    if options.resume:
        return _resume_repair(declared, skill, after, options)
    place = None if options.run_dir is None else as_path(options.run_dir, "run_dir")
    if place is not None and (place / "run.json").exists():
        raise RunError(
            f"{shown_path(place)} holds a run: name a new directory; or, if a repair was "
            "stopped there, add resume=True"
        )
    steps = options.steps or USUAL_STEPS
    done = options.done
    calls = options.calls
    learnt = parts_of(roles, policy)[skill]
    assert isinstance(learnt, AgentPolicy)
    content, policies = _content(declared, source, roles, policy)
    if declared.recorded and content.resume_needs_recipe:
        raise RunError(
            f"{shown_path(source)} was loaded without its code, and training needs that: load it "
            "with the hierarchy that was trained: sw.load(directory, hierarchy)"
        )
    config = alone(_settings(roles[skill].config, learnt))
    name = _stage_name(skill, {e.name for e in content.stages} | set(roles.skills))
    recorded = config_to_json(config)
    entry = StageEntry(name, "skill", [skill], None, steps, recorded, None, "waiting")
    check_stages([entry], None)
    if isinstance(config, OnPolicy) and steps < (one := config.n_steps * config.num_envs):
        raise DeclarationError(
            f"steps is {steps:,}, but {skill!r} learns for the first time after {one:,}; give more "
            "steps"
        )
    with Progress(quiet=options.quiet) as progress:
        found = _measured(
            declared, roles, policy, skill, after, done, calls, config.num_envs, progress
        )
    log = replace(found.log, features=declared.features)
    reason = str(log.blame(name_of(skill), name_of(after), done))
    reason += f" {found.shortage}" if found.shortage else ""
    before = matrix_to_json(found.matrix)
    known = sorted(done or ())
    entry.repair = RepairEntry(skill, after, calls, known, reason, before, found.gain)
    rehearsal = None
    role = roles[skill]
    assert role.skill is not None
    if can_rehearse(learnt.algorithm):
        rehearsal = rehearsed_obs(found.log, role.skill, role.part, name_of(after), done)
    else:
        reason += (
            f" {skill!r} learns on without rehearsal, so it may forget what it does elsewhere: "
            "only PPO without a memory rehearses."
        )

    def write(run: RunDirectory) -> None:
        """Write the policies of the stages that are done, and the observations of a rehearsal."""
        for stage, by_name in policies.items():
            run.save_policies(stage, by_name)
        for path in roles.files():
            if source.is_dir() and file_path(source, path).exists():
                copy_file(run, path, read_file(file_path(source, path)))
        if rehearsal is not None:
            save_rehearsal(run, entry.name, rehearsal)

    content = replace(content, stages=[*content.stages, entry], code=roles.code)
    return start_run(declared, content, options.training, reason, write, done)


def _settings(declared: Any, learnt: AgentPolicy) -> Any:
    """Return the settings by which a skill was declared to learn, with the networks that it has."""
    has: Any = learnt.algorithm.config
    return with_networks(declared, has) if type(has) is type(declared) else has


def _resume_repair(
    declared: Hierarchy, skill: str, after: str, options: RepairOptions
) -> Trained[Hierarchy]:
    """Finish a stopped run of ``Run.repair``, with the steps that it was started with."""
    if options.run_dir is None:
        raise DeclarationError(
            "resume=True continues a repair, so name its directory: "
            f'repair({name_of(skill)!r}, after={name_of(after)!r}, run_dir="runs/a", resume=True)'
        )
    run = RunDirectory.open(as_path(options.run_dir, "run_dir"))
    repairs = [(e, e.repair) for e in run.manifest.stages if e.repair is not None]
    if not repairs or (repairs[-1][1].skill, repairs[-1][1].after) != (skill, after):
        raise RunError(
            f"{shown_path(run.path)} holds no repair of {skill!r} after {after!r}; leave out "
            "resume=True to start one in another directory"
        )
    budget = repairs[-1][0].budget
    if options.steps not in (None, budget):
        raise DeclarationError(
            f"steps is {options.steps:,}, but this repair was started with {budget:,}: "
            "leave out steps"
        )
    return train_stages(apply_manifest(declared, run), run, options.training, done=options.done)


def _checked(roles: Roles, skill: Any, after: Any) -> tuple[str, str]:
    """Check the two skills that ``Run.repair`` is given, and return their paths.

    Raises:
        DeclarationError: the first one cannot learn, or may not follow the other one.
    """
    for argument, name in (("skill", skill), ("after", after)):
        known = roles.skills
        if not isinstance(name, str) or (argument == "skill" and name not in known):
            raise DeclarationError(
                f"{argument} is {short(name)}; it must be the name of a skill: {', '.join(known)}"
            )
    level = level_of(skill)
    names = roles.levels[level].names
    path = join(level, name_of(after))
    if path not in roles.skills or after not in (path, name_of(path)):
        raise DeclarationError(
            f"after is {short(after)}; it must be a skill that the same selector calls: "
            f"{', '.join(name for name in names if name != name_of(skill))}"
        )
    if path == skill:
        raise DeclarationError(f"{skill!r} cannot be repaired after itself: name another skill")
    if skill in roles.levels:
        inside = ", ".join(roles.levels[skill].skills)
        raise DeclarationError(
            f"{skill!r} is a hierarchy: repair a skill of it ({inside}), after another of these"
        )
    if roles[skill].config is None:
        raise DeclarationError(
            f"{skill!r} is ready: its policy was given, so it does not learn, and cannot be "
            f"repaired. To let it learn, {learn_on(skill)}. Or perhaps {name_of(after)!r} can end "
            "elsewhere"
        )
    return skill, path


def _measured(
    declared: Declaration,
    roles: Roles,
    policy: HierarchyPolicy,
    skill: str,
    after: str,
    done: Mapping[str, Any] | None,
    calls: int,
    num_envs: int,
    progress: Progress,
) -> Measured:
    """Measure the handover of the two skills of ``Run.repair`` before the new run.

    Raises:
        DeclarationError: there is nothing to repair, or the skill may not start there, or images
            need features.
    """
    level = parts_of(roles, policy)[level_of(skill)]
    assert isinstance(level, HierarchyPolicy)
    if words := lacking_features(
        declared.features, declared.spec.spaces.observation, level, name_of(skill)
    ):
        raise DeclarationError(words)
    names = name_of(skill), name_of(after)
    found = measure(roles.spec, level.skills, *names, done, calls, num_envs, progress.message)
    rate, count = found.matrix.of(*names)
    late = found.matrix.time_words(*names)
    if not count:
        why = late or "no call of it was done, or the episode ended with it"
        if not found.may_start and not late:
            why = f"the initiation() of {skill!r} was False wherever {after!r} ended"
        raise DeclarationError(
            f"{skill!r} was never called after {after!r}: {why}, so there is nothing to repair it "
            f"from. {found.shortage}"
        )
    often = f"let {after!r} be done more often first"
    if count < min(calls, FEWEST):
        raise DeclarationError(
            f"{skill!r} was called only {count} times after a call of {after!r} that was done, too "
            f"few to see whether a repair is better: {late or often}. {found.shortage}"
        )
    if rate >= GOOD:
        raise DeclarationError(
            f"{skill!r} is done in {rate:.0%} of {count} calls after {after!r}: there is nothing "
            "to repair"
        )
    return found


def _stage_name(skill: str, taken: set[str]) -> str:
    """Return a name for the stage in the new run of ``Run.repair``; no other stage has it."""
    name = f"{skill}-repair"
    number = 2
    while name in taken:
        name = f"{skill}-repair-{number}"
        number = number + 1
    return name


Policies = dict[str, dict[str, AgentPolicy]]
"""Policies by stage and learner."""


def _content(
    declared: Declaration, source: Path, roles: Roles, policy: HierarchyPolicy
) -> tuple[Manifest, Policies]:
    """Return the manifest of the new run of ``Run.repair``, with finished stages, and policies."""
    policies: Policies = {}
    if source.is_dir():
        run = RunDirectory.open(source)
        content = run.manifest
        for entry in content.stages:
            policies[entry.name] = run.load_policies(entry.name)
            entry.forget_files()
    else:
        content = training.manifest(declared, seed=0)
        parts = parts_of(roles, policy)
        for entry in content.stages:
            # A weights file does not record its training: the declaration's steps stand for it.
            entry.status = "done"
            entry.steps = entry.budget
            entry.seconds = 0.0
            if entry.kind == "together":
                entry.compared = entry.greedy_judged = False
            learnt = {name: parts[name] for name in entry.learns}
            policies[entry.name] = {k: p for k, p in learnt.items() if isinstance(p, AgentPolicy)}
    return replace(content, eval_every=None, keep="last"), policies
