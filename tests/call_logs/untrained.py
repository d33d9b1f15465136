"""Runs in the corridor of skills that nothing trained."""

from __future__ import annotations

from pathlib import Path

from ready_selectors.chain import SPEC, GetKey, Leave, OpenDoor, Wait, bound
from toys import skills_of

import skillweave as sw
from skillweave.api import Run
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.skills import ready_policy
from skillweave.skills.foreign_policy import fitted
from skillweave.skills.skill_set import SkillSet

SKILLS = (GetKey(), OpenDoor(), Leave(), Wait())


def skill_set(**how) -> SkillSet:
    return skills_of(*SKILLS, **how)


def run_of(*skills, spec: sw.EnvSpec = SPEC, **how) -> Run:
    """A run whose selector always calls the first skill, if no other is given."""
    skills = skills or SKILLS
    names = tuple(s.name for s in skills)
    rule = {"call_steps": None, "selector": lambda obs: [names[0]] * len(obs)}
    declared = sw.Hierarchy(spec, skills, **rule | how)
    ready = tuple(fitted(ready_policy(s), *spec.spaces, s.name, "corridor") for s in skills)
    skill_set = SkillSet(skills, ready, tuple(declared.reflexes))
    policy = HierarchyPolicy(bound(declared.selector, names), skill_set)
    return Run(declared, Path("runs/corridor"), policy)
