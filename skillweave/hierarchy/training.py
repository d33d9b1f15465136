"""Training by a run's manifest, and loading the result: a hierarchy, or one plain agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skillweave._internal.paths import SELECTOR, level_of
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.errors import DeclarationError, RunError
from skillweave.hierarchy.added_stages import added_stage
from skillweave.hierarchy.assembly import assembled, can_act
from skillweave.hierarchy.checks import check_nested
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.fitting import ready_policies, ready_selectors
from skillweave.hierarchy.recorded import level_entry, skill_entries
from skillweave.hierarchy.roles import Roles, roles_of
from skillweave.hierarchy.schedule import budgets_of, level_stages, stages_of
from skillweave.hierarchy.select_best import resolve_greedy, select_best
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.runs.command_words import repair_words, resume_words
from skillweave.runs.directory import RunDirectory
from skillweave.runs.initial_policies import (
    copy_file,
    copy_ready_policy,
    given_policies,
    policy_at_start,
)
from skillweave.runs.manifest import Manifest
from skillweave.runs.trackers import Listener
from skillweave.skills import ready_policy
from skillweave.skills.foreign_policy import as_recorded
from skillweave.training.agents import Agents
from skillweave.training.defaults import HIERARCHY_DEFAULTS, TrainDefaults
from skillweave.training.plain_agent import Declared, PlainAgent
from skillweave.training.stage import Policies, Stage
from skillweave.training.stage_run import MakeLearner
from skillweave.training.trainer import Course


def manifest(
    declaration: Declared,
    *,
    seed: int,
    flat: bool | AlgorithmConfig = False,
    how: TrainDefaults | None = None,
) -> Manifest:
    """Return the content of ``run.json`` for a new run of a declared hierarchy.

    Args:
        flat: a manifest of the flat baseline: with its own settings, or with these.
        how: evaluation and checkpoints; None: the declaration's defaults.
    """
    how = how or declaration.train_defaults
    if isinstance(declaration, PlainAgent):
        return declaration.manifest(seed, how)
    assert isinstance(declaration, Declaration)
    if flat is not False:
        return declaration.plain_agent(None if flat is True else flat).manifest(seed, how)
    roles = roles_of(declaration)
    check_nested(roles)
    stages = stages_of(roles)
    code = any(stage.acts_by_code for stage in stages)
    learns = any(stage.learns_by_code for stage in stages)
    _check_log_calls(stages, how)
    leaves = {path: skill for path, skill in roles.skills.items() if path not in roles.levels}
    ready = {path: p for path, s in leaves.items() if (p := ready_policy(s)) is not None}
    return Manifest(
        env=roles.spec.name,
        env_kwargs=roles.spec.json_kwargs,
        code=roles.code,
        hierarchy=level_entry(roles, roles.outermost),
        skills=skill_entries(roles, ready | roles.bases()),
        seed=seed,
        stages=[stage.entry() for stage in stages],
        needs_recipe=code or not roles.is_data,
        resume_needs_recipe=learns or not roles.trains_from_data,
        **how.entries(HIERARCHY_DEFAULTS),
    )


def _check_log_calls(stages: Sequence[Stage], how: TrainDefaults) -> None:
    """Raise a DeclarationError where calls cannot be logged in stages of a hierarchy."""
    if how.log_calls is None:
        if how.log_calls_info:
            raise DeclarationError(
                "log_calls_info names keys for the log of calls: set log_calls, too"
            )
        return
    if not any(s.level == "" and s.kind in ("selector", "together") for s in stages):
        raise DeclarationError(
            "log_calls is set, but no selector acts while this hierarchy trains, as each skill "
            "learns apart and the selector is ready: leave out log_calls, and record calls "
            "afterwards with run.log_calls()"
        )


@torch_threads(1)  # a loop sets its own; the rest must not depend on the number of threads
def train(
    declaration: Declared,
    run: RunDirectory,
    listeners: tuple[Listener, ...] = (),
    make_learner: MakeLearner = Agents,
    done: Mapping[str, Any] | None = None,
) -> Policy:
    """Train, or finish training, the stages of a declaration's run; return its policy.

    Args:
        done: the events by which a repair is judged, as for ``planning.handover``.
    """
    course = Course(run, listeners, make_learner, done)
    if run.manifest.hierarchy is None:
        agent = declaration.plain_agent() if isinstance(declaration, Declaration) else declaration
        (stage,) = agent.stages()
        return course.train([stage], {})[stage.name]
    assert isinstance(declaration, Declaration)
    roles = _with_recorded_bases(roles_of(declaration), run)
    policies: Policies = _ready(roles, run)
    for path, policy in {**policies, **roles.bases()}.items():
        copy_ready_policy(run, path, policy)
    for path, file in roles.files().items():
        copy_file(run, path, file.content)
    budgets = budgets_of(roles)
    for level in roles.trained:
        # What has learnt together so far may have decided whether skills sample.
        decided = resolve_greedy(roles, run)
        stages = level_stages(decided, decided.levels[level.path], budgets)
        apart = [s for s in stages if s.kind != "together"]
        policies = course.train(apart, policies)
        if len(apart) < len(stages):
            after = course.train(stages[len(apart) :], policies)
            before = {**policies, **given_policies(run, stages[-1].name)}
            policies = select_best(roles, level, course, before, after)
    roles = resolve_greedy(roles, run)
    policy = assembled(roles, _repaired(roles, course, policies))
    check_parts(roles, policy, str(run.path))
    return policy


def _repaired(roles: Roles, course: Course, policies: Policies) -> Policies:
    """Train the repairs that a hierarchy's run records; return its policies after them."""
    run, done = course.run, course.done
    for entry in run.manifest.stages:
        if (repair := entry.repair) is None:
            continue
        if entry.kept is None and repair.done and done is None:
            raise RunError(
                f"{run.path}: the repair is judged by done= of "
                f"{', '.join(repair.done)}, which is code: "
                f"continue it by {repair_words(repair, run)}"
            )
        kind = added_stage("repair")
        after = course.train([kind.make(roles, entry, done)], policies)
        if kind.judge(roles, course, entry, assembled(roles, after)):
            policies = after
    return policies


def load(roles: Roles, run: RunDirectory) -> Policy:
    """Return the policy of a finished run of a hierarchy."""
    roles = _with_recorded_bases(roles, run)
    policies = _ready(roles, run) | _learnt(run)
    if run.lacks_comparison:
        raise RunError(
            f"{run.path}: all is trained, but the best of the hierarchies that it could end with "
            f"was not judged yet; {resume_words(run)}"
        )
    absent = [path for path in roles.outermost.skills if not can_act(roles, path, policies)]
    if absent:
        raise RunError(
            f"{run.path}: {', '.join(map(repr, absent))} did not learn there: declare the skills "
            "with the policies that they had when it was trained"
        )
    roles = resolve_greedy(roles, run)
    policy = assembled(roles, policies)
    check_parts(roles, policy, str(run.path))
    return policy


def _learnt(run: RunDirectory) -> dict[str, Policy]:
    """Return the trained policies of a hierarchy's finished run, by path."""
    policies: dict[str, Policy] = {}
    for entry in run.manifest.stages:
        if not entry.undone:
            policies |= run.load_policies(entry.name)
    return policies


def _with_recorded_bases(roles: Roles, run: RunDirectory) -> Roles:
    """Return the roles with the policies that skills correct as they were when the run started."""
    return roles.with_bases(lambda path, policy: policy_at_start(run, path, policy))


def _ready(roles: Roles, run: RunDirectory) -> dict[str, Policy]:
    """Return the ready policies and selectors as they were when the run started, by path."""
    policies = {
        path: policy_at_start(run, path, policy) for path, policy in ready_policies(roles).items()
    }
    entries = run.manifest.levels
    for path, policy in ready_selectors(roles).items():
        source = entries[level_of(path)].selector
        described = f"{run.path}: the selector" + ("" if path == SELECTOR else f" {path}")
        policies[path] = as_recorded(policy, source, lambda: None, described)
    for level in roles.levels.values():
        for selector in (level.ready_selector, level.ready_guide):
            if selector is not None:
                selector.check_environment(level.spec)
        if (guide := level.restricting_guide) is not None:
            described = f"{run.path}: the guide" + (f" of {level.path}" if level.path else "")
            recorded = entries[level.path].guide
            source = None if recorded is None else recorded.source
            as_recorded(guide, source, lambda: None, described)
    return policies
