"""A hierarchy's settings by their bare names, put into the groups that they belong to.

Benchmarks and tests vary single settings of any group; this saves each of them the grouping.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from skillweave import Apart, Hierarchy, Selection, Skill, Together, TrainDefaults
from skillweave.types import Policy

GROUPS: dict[str, Any] = {
    "apart": Apart,
    "together": Together,
    "selection": Selection,
    "train_defaults": TrainDefaults,
}
"""By field of a hierarchy, the class of its group."""
PLACES = {
    f.name: (group, f.name)
    for group, kind in GROUPS.items()
    for f in fields(kind)
    if f.name not in ("steps", "flat")
} | {"together_steps": ("together", "steps")}
"""By bare name, the group and the field there."""


def grouped(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return keyword arguments of ``Hierarchy`` for ``settings`` by bare names.

    ``{"skill_steps": 100, "call_steps": 5}`` gives ``{"apart": Apart(skill_steps=100),
    "call_steps": 5}``. ``together_steps`` is ``Together.steps``; groups among ``settings`` are
    kept, with these fields replaced.
    """
    found = {k: v for k, v in settings.items() if k not in PLACES}
    for name, value in settings.items():
        if name in PLACES:
            group, field = PLACES[name]
            found[group] = replace(found.get(group) or GROUPS[group](), **{field: value})
    return found


def regroup(hierarchy: Hierarchy, **settings: Any) -> None:
    """Set ``settings`` by bare names on a hierarchy, in place."""
    own = {name: getattr(hierarchy, name) for name in GROUPS}
    for name, value in grouped(own | settings).items():
        setattr(hierarchy, name, value)


def act_by(skill: Skill, policy: Policy) -> None:
    """Let a skill act by a policy that is there already, without its settings of training."""
    skill.policy, skill.algorithm, skill.steps = policy, None, None
