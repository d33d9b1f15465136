"""Training by a run's manifest, and loading the result: a hierarchy, or one plain agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.collecting.lengths import calls_to_json
from skillweave.errors import DeclarationError, RunError
from skillweave.hierarchy.assembly import assembled, can_act
from skillweave.hierarchy.checks import check_nested
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.fitting import ready_policies, ready_selectors
from skillweave.hierarchy.repair import judge_repair, repair_stage
from skillweave.hierarchy.roles import Level, Roles, roles_of
from skillweave.hierarchy.schedule import budgets_of, level_stages, stages_of
from skillweave.hierarchy.select_best import resolve_greedy, select_best
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.paths import SELECTOR, level_of
from skillweave.planning import Planner
from skillweave.runs.command_words import repair_words, resume_words
from skillweave.runs.copies import copy_ready_policy, policy_at_start
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import SkillEntry
from skillweave.runs.trackers import Listener
from skillweave.skills import ready_policy
from skillweave.skills.foreign_policy import as_recorded, source_of
from skillweave.skills.goals import goals_of
from skillweave.skills.own_part import part_to_json
from skillweave.skills.residual import Residual
from skillweave.spaces import space_to_json
from skillweave.training.defaults import TrainDefaults
from skillweave.training.joint import agents_of
from skillweave.training.options import CallReports, Reports
from skillweave.training.plain_agent import Declared, PlainAgent
from skillweave.training.stage import Policies, Stage
from skillweave.training.stage_run import MakeLearner
from skillweave.training.trainer import Course
from skillweave.types import Policy


def manifest(
    declaration: Declared,
    *,
    seed: int,
    flat: bool | AlgorithmConfig = False,
    how: TrainDefaults | None = None,
) -> dict[str, Any]:
    """Return the content of a new run's ``run.json``.

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
    return {
        "kind": "hierarchy",
        "env": roles.spec.name,
        "env_kwargs": roles.spec.json_kwargs,
        "code": roles.code,
        "seed": seed,
        **_reports(stages, how),
        "skills": [_skill_entry(roles, path) for path in roles.skills],
        **_level_entry(roles, roles.outermost),
        "resume_needs_recipe": learns or not roles.trains_from_data,
        "needs_recipe": code or not roles.is_data,
        "stages": [stage.entry() for stage in stages],
    }


def _reports(stages: Sequence[Stage], how: TrainDefaults) -> dict[str, Any]:
    """Return the entries of evaluations, checkpoints and logs, also of calls if they are logged.

    Raises:
        DeclarationError: no stage has calls to log.
    """
    if how.log_calls is None:
        if how.log_calls_info:
            raise DeclarationError(
                "log_calls_info names keys for the log of calls: set log_calls, too"
            )
        return how.entries(Reports)
    if not any(s.level == "" and s.kind in ("selector", "together") for s in stages):
        raise DeclarationError(
            "log_calls is set, but no selector acts while this hierarchy trains, as each skill "
            "learns apart and the selector is ready: leave out log_calls, and record calls "
            "afterwards with run.log_calls()"
        )
    return how.entries(CallReports)


@torch_threads(1)  # a loop sets its own; the rest must not depend on the number of threads
def train(
    declaration: Declared,
    run: RunDirectory,
    listeners: tuple[Listener, ...] = (),
    make_learner: MakeLearner = agents_of,
    done: Mapping[str, Any] | None = None,
) -> Policy:
    """Train, or finish training, the stages of a run; return the policy.

    Args:
        done: the events by which a repair is judged, as for ``planning.handover``.
    """
    course = Course(run, listeners, make_learner, done)
    if run.manifest["kind"] == "agent":
        agent = declaration.plain_agent() if isinstance(declaration, Declaration) else declaration
        (stage,) = agent.stages()
        return course.train([stage], {})[stage.name]
    assert isinstance(declaration, Declaration)
    roles = _with_recorded_bases(roles_of(declaration), run)
    policies: Policies = _ready(roles, run)
    for path, policy in {**policies, **roles.bases()}.items():
        copy_ready_policy(run, path, policy)
    budgets = budgets_of(roles)
    for level in roles.trained:
        # What has learnt together so far may have decided whether skills sample.
        decided = resolve_greedy(roles, run)
        stages = level_stages(decided, decided.levels[level.path], budgets)
        apart = [s for s in stages if s.kind != "together"]
        policies = course.train(apart, policies)
        if len(apart) < len(stages):
            after = course.train(stages[len(apart) :], policies)
            policies = select_best(roles, level, course, policies, after)
    roles = resolve_greedy(roles, run)
    return assembled(roles, _repaired(roles, course, policies))


def _repaired(roles: Roles, course: Course, policies: Policies) -> Policies:
    """Train, or finish training, the repairs of a run; return the policies that it ends with."""
    run, done = course.run, course.done
    for entry in run.manifest["stages"]:
        if (repair := entry.repair) is None:
            continue
        if entry.kept is None and repair.done and done is None:
            raise RunError(
                f"{run.path}: the repair is judged by done= of "
                f"{', '.join(repair.done)}, which is code: "
                f"continue it by {repair_words(repair, run)}"
            )
        after = course.train([repair_stage(roles, entry, repair, done)], policies)
        if judge_repair(roles, course, entry, repair, assembled(roles, after)):
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
    """Return the trained policies of a finished run, by path."""
    policies: dict[str, Policy] = {}
    for entry in run.manifest["stages"]:
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
    for path, policy in ready_selectors(roles).items():
        entry = _entry_of(run, level_of(path))
        described = f"{run.path}: the selector" + ("" if path == SELECTOR else f" {path}")
        policies[path] = as_recorded(policy, entry.get(SELECTOR), lambda: None, described)
    for level in roles.levels.values():
        for selector in (level.ready_selector, level.ready_guide):
            if isinstance(selector, Planner):
                selector.log.check_environment(level.spec)
        if (guide := level.restricting_guide) is not None:
            described = f"{run.path}: the guide" + (f" of {level.path}" if level.path else "")
            recorded = _entry_of(run, level.path).get("guide")
            as_recorded(guide, recorded, lambda: None, described)
    return policies


def _entry_of(run: RunDirectory, path: str) -> dict[str, Any]:
    """Return a run's entry of the level at ``path``."""
    if not path:
        return run.manifest
    entries: list[SkillEntry] = run.manifest["skills"]
    return next((dict(s.hierarchy or {}) for s in entries if s.name == path), {})


def _skill_entry(roles: Roles, path: str) -> SkillEntry:
    """Return a run's entry of a skill."""
    skill, inner = roles.skills[path], roles.levels.get(path)
    policy = ready_policy(skill) if inner is None else None
    goals_of(skill)  # a space that is not supported is named with its skill
    recorded, part = policy, roles[path].part
    if policy is None and isinstance(skill.policy, Residual) and part is not None:
        recorded = part.base
    source: Any = None if recorded is None else source_of(recorded)
    level: Any = None if inner is None else _level_entry(roles, inner)
    return SkillEntry(
        path,
        skill.max_steps,
        ready=policy is not None,
        call_steps=skill.call_steps,
        goal_space=None if skill.goal_space is None else space_to_json(skill.goal_space),
        policy=source,
        hierarchy=level,
        **part_to_json(skill, roles[path].rest, f"skill {path!r}"),
    )


def _level_entry(roles: Roles, level: Level) -> dict[str, Any]:
    """Return a run's entry of a level's settings.

    Unless all its parts learn together in a stage, skills and selector are greedy by default.
    """
    together = any(map(roles.learns_together, roles.levels_to(level.path)))
    selection = level.selection
    apart = level.apart
    skills = selection.greedy_skills
    selector = selection.greedy_selector
    return {
        **calls_to_json(level.call_steps),
        "learn": level.learn,
        "interrupt": level.together.margin if level.together.interrupt else None,
        "greedy_skills": True if skills is None and not together else skills,
        "greedy_selector": True if selector is None and not together else selector,
        "reflexes": [r.name for r in level.reflexes],
        "start_calls": list(calls) if isinstance(calls := apart.start_calls, tuple) else calls,
        "search_steps": apart.search_steps,
        "episode_calls": apart.episode_calls,
        "call_cost": selection.call_cost,
        **_selector_entry(level),
    }


def _selector_entry(level: Level) -> dict[str, Any]:
    """Return the entry of a ready selector's source, or of a trained one's guide."""
    if level.ready_selector is not None:
        return {SELECTOR: source_of(level.ready_selector)}
    if level.guide is None or level.ready_guide is None:
        return {}
    return {
        "guide": source_of(level.ready_guide),
        "guide_restrict": level.guide.restrict,
        "guide_kl": level.guide.target_kl,
    }
