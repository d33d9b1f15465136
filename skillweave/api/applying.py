"""Compare a declaration with a run, and apply the run's manifest to it."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from skillweave._internal.notices import notice
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.agent_policy import AgentHeader
from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.hierarchy import training
from skillweave.hierarchy.declaration import Declaration, with_roles
from skillweave.hierarchy.recorded import (
    check_guided,
    check_same_part,
    check_selector,
    with_entry,
)
from skillweave.hierarchy.roles import Level, Roles, roles_of
from skillweave.reporting.facts import plain
from skillweave.runs.command_words import called_by
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Manifest, SkillEntry, settings_of
from skillweave.runs.user_code import environment_texts, notice_changes
from skillweave.skills import Skill
from skillweave.skills.goal_spaces import other_goals
from skillweave.spaces import space_from_json
from skillweave.training.plain_agent import Declared, load_agent_of

MOST_NAMED = 3
"""Settings that a message names."""

D = TypeVar("D", bound=Declared)
Trained = tuple[D, RunDirectory, Policy]
"""A declaration with a run's manifest applied, the run, and its policy."""


def load_policy(declared: D, path: Path) -> Trained[D]:
    """Open the finished run at ``path`` and load its policy.

    Raises:
        RunError: there is no run, it is not finished or damaged, or is one of another declaration.
    """
    run = RunDirectory.open(path)
    declared.validate()
    with called_by(declared._caller):
        given = declared
        declared = apply_manifest(declared, run)
        if isinstance(given, Declaration) and isinstance(declared, Declaration):
            _notice_limits(roles_of(given), roles_of(declared), run)
        if run.manifest.hierarchy is None:
            return declared, run, load_agent_of(run)
        assert isinstance(declared, Declaration)
        return declared, run, training.load(roles_of(declared), run)


def apply_manifest(declared: D, run: RunDirectory) -> D:
    """Return a copy that calls its skills as a run does, here and in hierarchies below.

    Raises:
        RunError: the run is not one of this declaration.
    """
    check_run(declared, run)
    if not isinstance(declared, Declaration) or run.manifest.hierarchy is None:
        return declared
    return with_roles(declared, _recorded_roles(roles_of(declared), run))


def _recorded_roles(roles: Roles, run: RunDirectory) -> Roles:
    """Return the roles of a declaration with the settings that a run records."""
    entries, levels = run.manifest.by_path, run.manifest.levels

    def recorded(level: Level) -> Level:
        """Return a level with the settings and limits of its entry in the run."""
        entry = levels[level.path]
        where = f"{run.path}: {level.path}" if level.path else str(run.path)
        check_guided(level.guide is not None, entry.guide is not None, where)
        skills = {path: _limited(skill, entries[path]) for path, skill in level.skills.items()}
        return replace(with_entry(level, entry), skills=skills)

    return roles.changed(recorded)


LIMITS = ("max_steps", "call_steps", "fade")
"""What a run records of a skill's calls, and sets when it is loaded."""


def _notice_limits(now: Roles, then: Roles, run: RunDirectory) -> None:
    """Give a notice where limits of calls are declared otherwise than the run records them."""
    changed = []
    for path, level in then.levels.items():
        whose = f" of {path!r}" if path else ""
        limits = {f"call_steps{whose}": (level.call_steps, now.levels[path].call_steps)}
        for name, skill in level.skills.items():
            declared = now.levels[path].skills[name]
            for field in LIMITS:
                both = getattr(skill, field), getattr(declared, field)
                limits[f"{field} of skill {name!r}"] = both
        changed += [
            f"{name} is {recorded} (declared now: {declared})"
            for name, (recorded, declared) in limits.items()
            if recorded != declared
        ]
    if changed:
        notice(
            f"{run.path}: calls have the limits with which the run was trained: "
            f"{', '.join(changed)}. To use the new ones, train again: train(start_from=run)"
        )


def _limited(skill: Skill, entry: SkillEntry) -> Skill:
    """Return a copy of a declared skill with the limits of its calls that a run records."""
    limited = copy.copy(skill)
    for field in LIMITS:
        if getattr(skill, field) != getattr(entry, field):
            setattr(limited, field, getattr(entry, field))
    return limited


def differences(content: Manifest, run: RunDirectory, *, budgets: bool = True) -> str:
    """Describe the settings in which a run differs from a manifest; empty if none does.

    Args:
        content: the manifest that a new run would have.
        budgets: compare the steps of stages, too.
    """
    here = settings_of(content)
    there = settings_of(run.manifest)
    if not budgets:
        here = {k: v for k, v in here.items() if not k.endswith(".budget")}
    evolve = tuple(f"{s.name}." for s in run.manifest.stages if s.evolution)
    # A population's settings follow a plan. A file's place is no setting; its checksum is.
    both = [k for k in here if k in there and not k.startswith(evolve) and not k.endswith(".file")]
    # Greediness that this declaration leaves open cannot differ.
    greedy = ("greedy_skills", "greedy_selector")
    unset = {k for k in both if k.endswith(greedy) and here[k] is None}
    differ = [k for k in both if k not in unset and here[k] != there[k]]
    if not differ:
        return ""
    named = []
    for name in differ[:MOST_NAMED]:
        then, now = plain(there[name]), plain(here[name])
        if then == now:  # they differ in digits that people do not read
            then, now = repr(there[name]), repr(here[name])
        named.append(f"{name} is {then} (declared now: {now})")
    more = f", and {len(differ) - MOST_NAMED} more differ" if len(differ) > MOST_NAMED else ""
    return f"the run continues with its own settings: {', '.join(named)}{more}"


def check_run(declared: Declared, run: RunDirectory) -> None:
    """Raise a RunError where a run is not one of this declaration; notice other code."""
    code = environment_texts(declared.spec)
    if run.manifest.hierarchy is not None:
        if not isinstance(declared, Declaration):
            raise RunError(f"{run.path} is the run of a hierarchy, not of a plain agent")
        roles = roles_of(declared)
        _check_roles(roles, run)
        code = roles.code
    what = "hierarchy" if isinstance(declared, Declaration) else "agent"
    _check_place(declared.spec, what, run)
    notice_changes(run.manifest.code, code, f"{run.path} was trained")


def _check_roles(roles: Roles, run: RunDirectory) -> None:
    """Raise a RunError where a run was trained with other skills, selectors or reflexes."""
    mine = list(roles.skills)
    theirs = list(run.manifest.by_path)
    if mine != theirs:
        raise RunError(
            f"{run.path} was trained with the skills {', '.join(theirs)}, but this hierarchy "
            f"has {', '.join(mine)}"
        )
    for entry in run.manifest.skills:
        path = entry.name
        if (path in roles.levels) != (entry.hierarchy is not None):
            raise RunError(
                f"{run.path}: skill {path!r} is a hierarchy in the run or in "
                "this declaration, not in both; declare it as it was trained"
            )
        _check_goals(roles.skills[path], entry, f"{run.path}: skill {path!r}")
        check_same_part(roles, entry, str(run.path))
    levels = run.manifest.levels
    for path, level in roles.levels.items():
        where = f"{run.path}: {path}" if path else str(run.path)
        check_selector(level.ready_selector is not None, levels[path].selector is not None, where)
        _check_reflexes(level, levels[path].reflexes, where)


def _check_goals(skill: Skill, entry: SkillEntry, who: str) -> None:
    """Raise a RunError where a skill had other goals in its run."""
    if skill.goal_space is None or entry.goal_space is None:  # said where policies are fitted
        return
    if says := other_goals(space_from_json(entry.goal_space), skill.goal_space):
        raise RunError(f"{who} {says}")


def _check_reflexes(level: Level, theirs: list[str], where: str) -> None:
    """Raise a RunError where the reflexes are not ``theirs``, those of training."""
    mine = [str(r.name) for r in level.reflexes]
    if mine != theirs:
        raise RunError(
            f"{where} was trained with {_reflexes(theirs)}, but this hierarchy has "
            f"{_reflexes(mine)}: declare them as they were, or train again"
        )


def _reflexes(names: list[str]) -> str:
    return f"the reflexes {', '.join(names)}" if names else "no reflexes"


def _check_place(spec: EnvSpec, what: str, run: RunDirectory) -> None:
    """Raise a RunError where a run was trained in another environment.

    Args:
        spec: the declared environment.
        what: the word for what is declared on it: agent or hierarchy.
    """
    theirs, their_kwargs = run.manifest.env, run.manifest.env_kwargs
    mine, my_kwargs = spec.name, spec.json_kwargs
    if (theirs, their_kwargs) == (mine, my_kwargs):
        return
    renamed = ""
    if theirs == mine:
        theirs = f"{theirs} made with {their_kwargs}"
        mine = f"one made with {my_kwargs}"
    elif not isinstance(spec.env, str):
        renamed = f". If its function was only renamed, set {mine}.__name__ = {theirs!r}"
    raise RunError(
        f"{run.path} was trained on {theirs}, but this {what} is on {mine}. Load it where it was "
        f"trained; to try its policy elsewhere then: evaluate(run.policy, env){renamed}"
    )


def spec_of(header: Manifest | AgentHeader) -> EnvSpec:
    """Return the environment that a manifest or a weights file's header names.

    Raises:
        RunError: it needs code.
    """
    assert header.env is not None
    spec = EnvSpec(header.env, kwargs=header.env_kwargs)
    if not spec.is_data:
        raise RunError(f"the environment {spec.name!r} names code; give the recipe")
    return spec
