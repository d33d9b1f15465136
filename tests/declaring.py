"""Keyword arguments of ``Hierarchy`` for tests that vary single settings of any group."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.grouped import grouped
from skillweave import Guide, Hierarchy, Together
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
