"""A hierarchy's entries in files, of runs and of weights: written, compared and applied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from skillweave._internal.policy_protocol import Policy
from skillweave.errors import RunError
from skillweave.hierarchy.roles import Level, Roles
from skillweave.policies.untrusted import shown
from skillweave.runs.manifest import GuideEntry, LevelEntry, SkillEntry
from skillweave.skills.foreign_policy import Source, source_of
from skillweave.skills.goals import goals_of
from skillweave.skills.lengths import Lengths
from skillweave.skills.own_part import file_of, part_to_json
from skillweave.skills.residual import Residual
from skillweave.spaces import space_to_json


def skill_entries(roles: Roles, ready: Mapping[str, Policy]) -> list[SkillEntry]:
    """Return the entries of the skills of all levels, for ``run.json``.

    Args:
        roles: with the skills.
        ready: by path, ready policies of skills, and those that skills correct.
    """
    return [_skill_entry(roles, path, ready.get(path)) for path in roles.skills]


def _skill_entry(roles: Roles, path: str, policy: Policy | None) -> SkillEntry:
    """Return a skill's entry for ``run.json``; ``policy`` is ready, or the skill corrects it."""
    skill = roles.skills[path]
    file = file_of(skill)
    source = None if file is None else Source(**file.source())
    goals_of(skill)  # a space that is not supported is named with its skill
    return SkillEntry(
        path,
        skill.max_steps,
        ready=policy is not None and not isinstance(skill.policy, Residual),
        call_steps=skill.call_steps,
        fade=skill.fade,
        goal_space=None if skill.goal_space is None else space_to_json(skill.goal_space),
        policy=source if policy is None else source_of(policy),
        hierarchy=level_entry(roles, roles.levels[path]) if path in roles.levels else None,
        **part_to_json(skill, roles[path].rest, f"skill {path!r}"),
    )


def level_entry(roles: Roles, level: Level) -> LevelEntry:
    """Return a level's entry for ``run.json``: its settings.

    Unless all its parts learn together in a stage, skills and selector are greedy by default.
    """
    together = any(map(roles.learns_together, roles.levels_to(level.path)))
    selection = level.selection
    apart = level.apart
    calls = level.call_steps
    skills, selector = selection.greedy_skills, selection.greedy_selector
    ready = level.ready_selector
    guide = level.guide
    guiding = level.ready_guide
    guided = None
    if guide is not None and guiding is not None:
        guided = GuideEntry(source_of(guiding), guide.restrict, guide.target_kl)
    return LevelEntry(
        learn=level.learn,
        call_steps=None if isinstance(calls, Lengths) else calls,
        call_lengths=level.lengths,
        interrupt=level.together.margin if level.together.interrupt else None,
        greedy_skills=True if skills is None and not together else skills,
        greedy_selector=True if selector is None and not together else selector,
        start_calls=apart.start_calls,
        search_steps=apart.search_steps,
        episode_calls=apart.episode_calls,
        deliberation_cost=selection.deliberation_cost,
        reflexes=[reflex.name for reflex in level.reflexes],
        selector=None if ready is None else source_of(ready),
        guide=guided,
    )


def calls_of(entry: LevelEntry) -> int | Lengths | None:
    """Return the limit of calls in a level's entry of ``run.json`` or a weights file."""
    return Lengths(*entry.call_lengths) if entry.call_lengths else entry.call_steps


def with_entry(level: Level, entry: LevelEntry) -> Level:
    """Return a level with the settings of its entry in ``run.json`` or a weights file."""
    guide, margin = level.guide, entry.interrupt
    if guide is not None and entry.guide is not None:
        guide = replace(guide, restrict=entry.guide.restrict, target_kl=entry.guide.target_kl)
    return replace(
        level,
        learn=entry.learn,
        call_steps=calls_of(entry),
        together=replace(
            level.together,
            interrupt=margin is not None,
            margin=level.together.margin if margin is None else margin,
        ),
        selection=replace(
            level.selection,
            deliberation_cost=entry.deliberation_cost,
            greedy_skills=entry.greedy_skills,
            greedy_selector=entry.greedy_selector,
        ),
        apart=replace(
            level.apart,
            start_calls=entry.start_calls,
            search_steps=entry.search_steps,
            episode_calls=entry.episode_calls,
        ),
        guide=guide,
    )


def check_same_part(roles: Roles, entry: SkillEntry, where: str) -> None:
    """Raise a RunError where a skill's entry records another part of observations or actions.

    Args:
        roles: with the skill as it is declared now.
        entry: of the skill.
        where: the file or the run.
    """
    path = entry.name
    declared = part_to_json(roles.skills[path], roles[path].rest, f"skill {path!r}")
    for field in ("sees", "acts", "rest", "residual", "learns_on"):
        then = getattr(entry, field)
        now = declared.get(field)
        if then != now:
            raise RunError(
                f"{where}: skill {path!r} was trained with {field} {shown(then)}, but now it is "
                f"{shown(now)}: declare it as it was, or train again"
            )


def check_selector(is_ready: bool, recorded: bool, where: str) -> None:
    """Raise a RunError where of the recorded and the declared selector only one is ready."""
    if is_ready != recorded:
        kinds = ("a trained selector", "a ready one (a function, an automaton or a tree)")
        raise RunError(
            f"{where} has {kinds[recorded]}, but this hierarchy has {kinds[is_ready]}: declare the "
            "selector as it was, or train again"
        )


def check_guided(is_guided: bool, recorded: bool, where: str) -> None:
    """Raise a RunError where of the recorded and the declared selector only one has a guide."""
    if is_guided != recorded:
        has = ("no guide", "a guide")
        raise RunError(
            f"{where}: the selector has {has[recorded]}, but the selector of this hierarchy has "
            f"{has[is_guided]}: declare guide= as it was, or train again"
        )
