"""A hierarchy's policy, put together from the policies of all who are in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skillweave.collecting.calls import SkillSet
from skillweave.collecting.levels import UntrainedHierarchy
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.guidance import own_guide, restricting_guide
from skillweave.hierarchy.nesting import below, inner_of
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.skills import Skill
from skillweave.training.stage import CRITIC, SELECTOR
from skillweave.types import Policy


def assembled(declared: Declaration, found: Mapping[str, Policy]) -> HierarchyPolicy:
    """The hierarchy of these policies, which are named by their paths."""
    skills = declared.skill_set([policy_of(s, found) for s in declared.skills])
    if declared.together.interrupt:
        skills = with_interruption(skills, found[CRITIC], declared.together.margin)
    guide = restricting_guide(declared, found[SELECTOR].observation_space)
    return HierarchyPolicy(found[SELECTOR], skills, guide)


def policy_of(skill: Skill, found: Mapping[str, Policy]) -> Policy:
    """A skill's policy, put together where it is a hierarchy."""
    inner = inner_of(skill)
    return found[skill.name] if inner is None else assembled(inner, below(found, skill.name))


def can_act(skill: Skill, found: Mapping[str, Policy]) -> bool:
    """Whether a skill can act already; a hierarchy, whether all in it can."""
    if (inner := inner_of(skill)) is None:
        return skill.name in found
    own = below(found, skill.name)
    needed = [SELECTOR, *([CRITIC] if inner.together.interrupt else [])]
    return all(name in own for name in needed) and all(can_act(s, own) for s in inner.skills)


def learning_set(declared: Declaration, found: Mapping[str, Policy]) -> SkillSet:
    """The skills as they are while all learn together: without policies where they learn."""

    def acts(skill: Skill) -> Any:
        if skill.policy is None:
            return None
        if (inner := inner_of(skill)) is None:
            return found[skill.name]
        own = below(found, skill.name)
        selector = own[SELECTOR] if inner.ready_selector is not None else None
        return UntrainedHierarchy(learning_set(inner, own), selector, own_guide(inner))

    return declared.skill_set([acts(s) for s in declared.skills])
