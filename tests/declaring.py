"""Small hierarchies, declared by bare names of settings of any group."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from small_runs import OFF, ON, Balance, Left, Push

from benchmarks.grouped import grouped
from skillweave import EnvSpec, Guide, Hierarchy, Skill, Together
from skillweave.hierarchy.roles import roles_of
from skillweave.skills.skill_set import SkillSet


def plainly(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return keyword arguments of ``Hierarchy`` for ``settings`` by bare names.

    Unless ``settings`` say otherwise, skills learn apart, and follow their own reward alone. A
    ``guide`` has the values of ``guide_restrict`` and ``guide_kl``.
    """
    found = {"learn": "apart", "together": Together(task_weight=0.0)} | dict(settings)
    guide = {
        "restrict": found.pop("guide_restrict", True),
        "target_kl": found.pop("guide_kl", None),
    }
    if found.get("guide") is not None:
        found["guide"] = Guide(found["guide"], **guide)
    return grouped(found)


def skills_with(declared: Hierarchy, policies: Sequence[Any]) -> SkillSet:
    """Return all skills of a hierarchy with these policies, in their order."""
    level = roles_of(declared).outermost
    return level.skill_set(dict(zip(level.skills, policies, strict=True)))


def declare(*skills: Skill | Hierarchy, workers: int | None = 1, **how: Any) -> Hierarchy:
    """Declare skills that learn together on CartPole, unless ``how`` says otherwise."""
    options = {
        "env": EnvSpec("CartPole-v1", engine="sync", workers=workers),
        "skills": skills or [Left(), Balance(), Push()],
        "call_steps": 6,
        "algorithm": ON,
        "selector": ON,
        "learn": "together",
        "together_steps": 450,
        "skill_steps": 150,
        "selector_steps": 150,
        "checkpoint_every": 75,
    }
    return Hierarchy(**plainly(options | how))


class Other(Balance):
    """Learns from replay."""

    algorithm = OFF
