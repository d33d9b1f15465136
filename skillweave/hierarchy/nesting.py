"""Hierarchies as skills of hierarchies: how they are declared, checked and found again.

A skill whose ``policy`` is a hierarchy is trained inside: its own skills and its own selector. Who
is in it has a path: ``inner/skill``, ``inner/selector``.
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
"""What of a skill a hierarchy says by itself, and where."""
_ATTRIBUTES = ("call_steps", "max_steps", "color")


class Nestable:
    """A hierarchy as a skill of another one."""

    name: str
    skills: Any

    def as_skill(self, name: str | None = None, **attributes: Any) -> Skill:
        """This hierarchy as a skill that is trained inside another hierarchy.

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
        own = {"name": name or self.name, "policy": self}
        skill: Skill = type("Hierarchy", (Skill,), own | attributes)()
        return skill


def inner_of(skill: Skill) -> Declaration | None:
    """The hierarchy that a skill is; None: it is none, or one that was trained elsewhere."""
    return cast("Declaration", skill.policy) if isinstance(skill.policy, Nestable) else None


def inner_hierarchies(skills: Iterable[Skill]) -> Iterator[tuple[Skill, Declaration]]:
    """Those skills that are hierarchies, with these."""
    for skill in skills:
        if (inner := inner_of(skill)) is not None:
            yield skill, inner


def every_skill(skills: Iterable[Skill], path: str = "") -> Iterator[tuple[str, Skill]]:
    """All skills by their paths, those of a hierarchy after it."""
    for skill in skills:
        yield path + skill.name, skill
        if (inner := inner_of(skill)) is not None:
            yield from every_skill(inner.skills, f"{path}{skill.name}/")


def every_hierarchy(declared: Declaration) -> Iterator[tuple[str, Declaration]]:
    """A hierarchy, by an empty path, and all below it by theirs."""
    yield "", declared
    for name, skill in every_skill(declared.skills):
        if (inner := inner_of(skill)) is not None:
            yield name, inner


def copied(declared: D) -> D:
    """The same hierarchy, and the same below it: what is changed there is not changed here."""
    found = copy.copy(declared)
    found.skills = tuple(copy.copy(skill) for skill in declared.skills)
    for skill, inner in inner_hierarchies(found.skills):
        skill.policy = copied(inner)
    return found


def below(found: Mapping[str, T], name: str) -> dict[str, T]:
    """What has paths that begin with ``name``, by the rest of the path."""
    cut = len(name) + 1
    return {k[cut:]: v for k, v in found.items() if k.startswith(f"{name}/")}


def check_nested(declared: Declaration) -> None:
    """Raise a DeclarationError where a hierarchy cannot be a skill of this one.

    Afterwards messages call every skill by its path.
    """
    check_ends(declared)
    for skill, inner in inner_hierarchies(declared.skills):
        # How many processes step it is said by the outermost one, for all.
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
    """An environment's name, or more where the names are the same."""
    return one.spec.name if one.spec.name != other.spec.name else short(one.spec)


def check_ends(declared: Declaration) -> None:
    """Raise a DeclarationError where a hierarchy contains itself."""
    _check_ends((declared,), "")


def _check_ends(above: tuple[Any, ...], path: str) -> None:
    for skill, inner in inner_hierarchies(above[-1].skills):
        here = f"{path}{skill.name}"
        if any(inner is other for other in above):
            raise DeclarationError(
                f"{here} is a hierarchy that contains itself: it is among its own skills"
            )
        _check_ends((*above, inner), f"{here}/")
