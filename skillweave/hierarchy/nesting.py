"""Hierarchies as skills of hierarchies: declaration, checks and paths.

A skill whose ``policy`` is a hierarchy is trained inside: its own skills and its own selector. Each
part of it has a path: ``inner/skill``, ``inner/selector``.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

from skillweave.errors import DeclarationError
from skillweave.messages import short
from skillweave.skills import Skill

if TYPE_CHECKING:
    from skillweave.hierarchy.declaration import Declaration

T = TypeVar("T")
D = TypeVar("D", bound="Declaration")
_ELSEWHERE = {
    "algorithm": "selector=",
    "steps": "steps=",
    "target_return": "selection=Selection(target_return=...)",
    "target_success": "selection=Selection(target_return=...)",
}
"""Attributes of a skill that a hierarchy sets itself, and the argument that sets them."""
_ATTRIBUTES = ("call_steps", "max_steps", "color")


class Nestable:
    """A hierarchy as a skill of another one."""

    name: str
    skills: Any

    def as_skill(self, name: str | None = None, **attributes: Any) -> Skill:
        """Return this hierarchy as a skill that is trained inside another hierarchy.

        ``skills=[Center(), inner]`` is short for ``skills=[Center(), inner.as_skill()]``.

        Args:
            name: of the skill; None: the hierarchy's.
            attributes: of the skill: ``call_steps=30``, ``max_steps=100``. A subclass of ``Skill``
                with ``policy = inner`` may have methods, too: a reward, an end.

        Raises:
            DeclarationError: a skill has no such attribute.
        """
        for field in attributes:
            if field not in _ATTRIBUTES:
                raise DeclarationError(
                    f"{self.name}.as_skill(): a skill that is a hierarchy takes no {short(field)}; "
                    f"it takes {', '.join(_ATTRIBUTES)}"
                )
        defaults = {"name": name or self.name, "policy": self}
        skill: Skill = type("Hierarchy", (Skill,), defaults | attributes)()
        return skill


def inner_of(skill: Skill) -> Declaration | None:
    """Return the hierarchy that a skill is; None: it is a plain skill, or trained elsewhere."""
    return cast("Declaration", skill.policy) if isinstance(skill.policy, Nestable) else None


def inner_hierarchies(skills: Iterable[Skill]) -> Iterator[tuple[Skill, Declaration]]:
    """Yield the skills that are hierarchies, each with its hierarchy."""
    for skill in skills:
        if (inner := inner_of(skill)) is not None:
            yield skill, inner


def every_skill(skills: Iterable[Skill], path: str = "") -> Iterator[tuple[str, Skill]]:
    """Yield all skills with their paths; the skills of a hierarchy follow it."""
    for skill in skills:
        yield path + skill.name, skill
        if (inner := inner_of(skill)) is not None:
            yield from every_skill(inner.skills, f"{path}{skill.name}/")


def every_hierarchy(declared: Declaration) -> Iterator[tuple[str, Declaration]]:
    """Yield a hierarchy with an empty path, and all hierarchies below it with their paths."""
    yield "", declared
    for name, skill in every_skill(declared.skills):
        if (inner := inner_of(skill)) is not None:
            yield name, inner


def copied(declared: D) -> D:
    """Return a copy of a hierarchy, its skills and the hierarchies below it."""
    whole = copy.copy(declared)
    whole.skills = tuple(copy.copy(skill) for skill in declared.skills)
    for skill, inner in inner_hierarchies(whole.skills):
        skill.policy = copied(inner)
    return whole


def below(by_path: Mapping[str, T], name: str) -> dict[str, T]:
    """Return the values whose paths begin with ``name``, by the rest of the path."""
    start = len(name) + 1
    return {k[start:]: v for k, v in by_path.items() if k.startswith(f"{name}/")}


def check_nested(declared: Declaration) -> None:
    """Raise a DeclarationError where a hierarchy cannot be a skill of this one.

    Afterwards messages call every skill by its path.
    """
    check_ends(declared)
    for skill, inner in inner_hierarchies(declared.skills):
        # The outermost hierarchy sets the number of processes for all.
        if replace(inner.spec, workers=None) != replace(declared.spec, workers=None):
            raise DeclarationError(
                f"{skill.name}: this hierarchy is a skill of another one, so both act in the same "
                f"environment; but it is declared on {_shown(inner, declared)}, and the other on "
                f"{_shown(declared, inner)}"
            )
    for path, skill in every_skill(declared.skills):
        skill._path = path
        if inner_of(skill) is None:
            continue
        if isinstance(getattr(type(skill), "policy", None), property):
            raise DeclarationError(
                f"skill {path!r} is a hierarchy, but its policy is a property: make it a class "
                "attribute"
            )
        for field, where in _ELSEWHERE.items():
            if getattr(skill, field) is not None:
                raise DeclarationError(
                    f"skill {path!r} is a hierarchy, so it has no {field} of its own: give the "
                    f"hierarchy {where}"
                )


def _shown(one: Declaration, other: Declaration) -> str:
    """Return an environment's name, or its whole specification where the names are equal."""
    return one.spec.name if one.spec.name != other.spec.name else short(one.spec)


def check_ends(declared: Declaration) -> None:
    """Raise a DeclarationError where a hierarchy contains itself."""
    _check_ends((declared,), "")


def _check_ends(above: tuple[Any, ...], path: str) -> None:
    for skill, inner in inner_hierarchies(above[-1].skills):
        inner_path = f"{path}{skill.name}"
        if any(inner is other for other in above):
            raise DeclarationError(
                f"{inner_path} is a hierarchy that contains itself: it is among its own skills"
            )
        _check_ends((*above, inner), f"{inner_path}/")
