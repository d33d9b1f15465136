"""Assembly of a hierarchy's policy from the policies of its selector and skills."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skillweave.collecting.levels import UntrainedHierarchy
from skillweave.collecting.skill_set import SkillSet
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import learning_guide, restricting_guide
from skillweave.hierarchy.nesting import below, inner_of
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.skills import Skill
from skillweave.training.stage import CRITIC, SELECTOR
from skillweave.types import Policy


def assembled(declared: Declaration, policies: Mapping[str, Policy]) -> HierarchyPolicy:
    """Return the policy of a hierarchy from policies by path."""
    skills = declared.skill_set([policy_of(s, policies) for s in declared.skills])
    if declared.together.interrupt:
        skills = with_interruption(skills, policies[CRITIC], declared.together.margin)
    guide = restricting_guide(declared, policies[SELECTOR].observation_space)
    return HierarchyPolicy(policies[SELECTOR], skills, guide)


def policy_of(skill: Skill, policies: Mapping[str, Policy]) -> Policy:
    """Return a skill's policy; assembled where the skill is a hierarchy."""
    inner = inner_of(skill)
    return policies[skill.name] if inner is None else assembled(inner, below(policies, skill.name))


def can_act(skill: Skill, policies: Mapping[str, Policy]) -> bool:
    """Return True if a skill, or every part of a hierarchy, has a policy already."""
    if (inner := inner_of(skill)) is None:
        return skill.name in policies
    inside = below(policies, skill.name)
    needed = [SELECTOR, *([CRITIC] if inner.together.interrupt else [])]
    return all(name in inside for name in needed) and all(can_act(s, inside) for s in inner.skills)


def learning_set(declared: Declaration, policies: Mapping[str, Policy]) -> SkillSet:
    """Return the skills for learning together: without a policy where a skill learns."""

    def ready_part(skill: Skill) -> Any:
        if skill.policy is None:
            return None
        if (inner := inner_of(skill)) is None:
            return policies[skill.name]
        inside = below(policies, skill.name)
        selector = inside[SELECTOR] if inner.ready_selector is not None else None
        return UntrainedHierarchy(learning_set(inner, inside), selector, learning_guide(inner))

    return declared.skill_set([ready_part(s) for s in declared.skills])
