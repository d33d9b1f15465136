"""Checks of a declared hierarchy's fields; the messages name the skill and the field."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from skillweave.algorithms.config import AlgorithmSettings
from skillweave.collecting.lengths import Lengths
from skillweave.errors import DeclarationError
from skillweave.hierarchy.nesting import Nestable, inner_of
from skillweave.messages import short
from skillweave.settings import fitted
from skillweave.skills import Reflex, Skill, ready_policy
from skillweave.training.stage import Target, target_of


def checked_skills(skills: object, reserved: Collection[str]) -> tuple[Skill, ...]:
    """Return the skills as a tuple, with hierarchies among them as skills.

    Raises:
        DeclarationError: no hierarchy can be made of them.
    """
    if isinstance(skills, str) or not isinstance(skills, Sequence):
        raise DeclarationError("skills must be a list of skills: skills=[Center(), ...]")
    if not skills:
        raise DeclarationError("a hierarchy needs at least one skill: skills is empty")
    skills = [s.as_skill() if isinstance(s, Nestable) else s for s in skills]
    for skill in skills:
        if not isinstance(skill, Skill):
            hint = " (write Center(), not Center)" if isinstance(skill, type) else ""
            raise DeclarationError(f"skills holds {short(skill)}, which is not a Skill{hint}")
        skill.validate()
        fitted(AlgorithmSettings | None, skill.algorithm, f"skill {skill.name!r}: algorithm")
        check_target(skill)
        if inner_of(skill) is None and ready_policy(skill) is not None:  # raises if it cannot act
            _check_untrained(skill)
    names = [s.name for s in skills]
    for name in names:
        if names.count(name) > 1:
            raise DeclarationError(
                f"two skills are named {name!r}; give one another name: class attribute 'name'"
            )
        if alike := [k for k in names if k != name and k.lower() == name.lower()]:
            raise DeclarationError(
                f"the skills {name!r} and {alike[0]!r} differ in case alone, and some file systems "
                "take their files for one; give one another name: class attribute 'name'"
            )
        if name.lower() in reserved:
            raise DeclarationError(f"a skill cannot be named {name!r}, which names a stage")
    return tuple(skills)


_OF_TRAINING = ("algorithm", "steps", "task_weight", "target_return", "target_success")
"""Attributes of a skill that set its training."""


def _check_untrained(skill: Skill) -> None:
    """Raise a DeclarationError where a skill with a policy has settings of its training.

    A policy that is given later (to the object of a class, or in a subclass) replaces a training:
    settings of it from before are no mistake.
    """
    given = _distance(skill, "policy")
    ignored = [
        field
        for field in _OF_TRAINING
        if getattr(skill, field) is not None and _distance(skill, field) <= given
    ]
    if ignored:
        fields = " and ".join(ignored)
        advice = f"leave out {fields}"
        if not given:  # perhaps a function has made the object and set them
            advice += f" (or set them to None: {', '.join(f'skill.{f} = None' for f in ignored)})"
        raise DeclarationError(
            f"skill {skill.name!r} has a policy, so it is not trained, and its {fields} would be "
            f"ignored: {advice}, or leave out policy to train it. To train a skill of another "
            "run of Skillweave further, leave out policy and call "
            f"train(start_from={{{skill.name!r}: run}})"
        )


def _distance(skill: Skill, field: str) -> int:
    """Return the place of a skill's field: 0 on the object, 1 in its class, more in those above."""
    places = [vars(skill), *map(vars, type(skill).__mro__)]
    return next((i for i, names in enumerate(places) if field in names), len(places))


def checked_reflexes(reflexes: object) -> tuple[Reflex, ...]:
    """Return the reflexes as a tuple.

    Raises:
        DeclarationError: the argument is no list of reflexes.
    """
    if isinstance(reflexes, str) or not isinstance(reflexes, Sequence):
        raise DeclarationError(
            f"reflexes is {short(reflexes)}; it must be a list: reflexes=[Reflex(...)]"
        )
    for reflex in reflexes:
        if not isinstance(reflex, Reflex):
            raise DeclarationError(
                f"reflexes holds {short(reflex)}, which is not a Reflex: Reflex(condition, action)"
            )
    return tuple(reflexes)


def check_calls(call_steps: int | Lengths | None, skills: Sequence[Skill]) -> None:
    """Raise a DeclarationError where calls of skills would never end."""
    if call_steps is not None:
        return
    for skill in skills:
        if not (skill.max_steps or skill.call_steps or skill.defines("termination")):
            raise DeclarationError(
                f"call_steps is None, but skill {skill.name!r} never ends by itself: give it "
                "max_steps or termination()"
            )


def check_target(skill: Skill) -> Target | None:
    """Return the target of a skill's stage.

    Raises:
        DeclarationError: the skill has two targets, or has one of success without success().
    """
    where = f"skill {skill.name!r}"
    target = target_of(skill.target_return, skill.target_success, where)
    if target is not None and target.of == "success" and not skill.defines("success"):
        raise DeclarationError(f"{where} has a target_success, but no success(): define success()")
    return target
