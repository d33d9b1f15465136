"""Assembly of a hierarchy's policy from the policies of its parts, by path; and its parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skillweave._internal.policy_protocol import Policy
from skillweave.hierarchy.fitting import learning_guide, restricting_guide
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.hierarchy.roles import Level, Roles
from skillweave.skills.goals import goals_of
from skillweave.skills.own_part import OwnPart
from skillweave.skills.skill_set import SkillSet, UntrainedHierarchy


def assembled(roles: Roles, policies: Mapping[str, Policy], path: str = "") -> HierarchyPolicy:
    """Return the hierarchy policy of a level, made of the policies of its parts, by path."""
    whole: dict[str, Any] = dict(policies)
    for level in reversed(roles.levels_from(path)):
        skills = level.skill_set({p: whole[p] for p in level.skills})
        if level.together.interrupt:
            skills = with_interruption(skills, whole[level.critic_path], level.together.margin)
        selector = whole[level.selector_path]
        guide = restricting_guide(level, selector.observation_space)
        goals = goals_of(level.as_skill)
        whole[level.path] = HierarchyPolicy(selector, skills, guide, goals)
    policy: HierarchyPolicy = whole[path]
    return policy


def policy_at(roles: Roles, policies: Mapping[str, Policy], path: str) -> Policy:
    """Return the policy of the skill at ``path``; assembled where the skill is a hierarchy."""
    return assembled(roles, policies, path) if path in roles.levels else policies[path]


def can_act(roles: Roles, path: str, policies: Mapping[str, Policy]) -> bool:
    """Return True if the skill at ``path``, or every part of a hierarchy, has a policy already."""
    if path not in roles.levels:
        return path in policies
    parts = [
        role.path
        for role in roles.below(path)
        if role.path not in roles.levels and (role.kind != "critic" or role.margin is not None)
    ]
    return all(part in policies for part in parts)


def parts_of(roles: Roles, policy: HierarchyPolicy) -> dict[str, Policy]:
    """Return the policies of all parts of a hierarchy's policy, and the policy itself, by path."""
    parts: dict[str, Policy] = {"": policy}
    for level in roles.levels.values():
        whole = parts[level.path]
        assert isinstance(whole, HierarchyPolicy)
        parts[level.selector_path] = whole.selector
        interruption = whole.skills.interruption
        if interruption is not None and interruption.critic is not None:
            parts[level.critic_path] = interruption.critic
        by_name = dict(zip(whole.labels, whole.skills.policies, strict=True))
        parts |= {path: by_name[skill.name] for path, skill in level.skills.items()}
    return parts


def own_parts_of(roles: Roles, policy: HierarchyPolicy) -> dict[str, OwnPart]:
    """Return the own parts of skills in a hierarchy's policy, by path."""
    found: dict[str, OwnPart] = {}
    whole = parts_of(roles, policy)
    for level in roles.levels.values():
        acting = whole[level.path]
        assert isinstance(acting, HierarchyPolicy)
        pairs = zip(level.skills, acting.skills.parts, strict=False)  # none, or one for each skill
        found |= {path: part for path, part in pairs if part is not None}
    return found


def learning_set(roles: Roles, level: Level, policies: Mapping[str, Policy]) -> SkillSet:
    """Return the skills of a level for learning together: without a policy where one learns."""
    parts: dict[str, Any] = {
        role.path: None if role.config is not None else policies[role.path]
        for role in roles.below(level.path)
        if role.kind == "skill" and role.path not in roles.levels
    }
    _, *inside = roles.levels_from(level.path)
    for inner in reversed(inside):
        selector = policies[inner.selector_path] if inner.ready_selector is not None else None
        guide = learning_guide(roles, inner)
        parts[inner.path] = UntrainedHierarchy(
            inner.skill_set(parts), selector, guide, goals_of(inner.as_skill)
        )
    return level.skill_set(parts)
