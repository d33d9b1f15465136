"""Checks of what a hierarchy is declared with; the messages name the skill and the field."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from skillweave.collecting.lengths import Lengths
from skillweave.errors import SkillweaveError
from skillweave.hierarchy.nesting import Nestable, inner_of
from skillweave.hierarchy.settings import Apart, Guide, Selection
from skillweave.messages import short
from skillweave.skills import Reflex, Skill, ready_policy
from skillweave.training.checks import check_algorithm
from skillweave.training.defaults import TrainDefaults
from skillweave.training.stage import Target, Together, target_of

GROUPS = {
    "apart": (Apart, "Apart(skill_steps=100_000)"),
    "together": (Together, "Together(task_weight=1.0)"),
    "selection": (Selection, "Selection(call_cost=0.1)"),
    "guide": (Guide, "Guide(automaton)"),
    "train_defaults": (TrainDefaults, "TrainDefaults(eval_every=50_000)"),
}
"""By field of a hierarchy, the class of its group of settings, and an example."""


def check_groups(declared: object) -> None:
    """Raise a SkillweaveError where a group of settings is something else."""
    for name, (kind, example) in GROUPS.items():
        value = getattr(declared, name)
        if not isinstance(value, kind) and not (name == "guide" and value is None):
            raise SkillweaveError(f"{name} is {short(value)}; write {name}={example}")


def checked_skills(skills: object, reserved: Collection[str]) -> tuple[Skill, ...]:
    """The skills, if a hierarchy can be made of them.

    Raises:
        SkillweaveError: it cannot.
    """
    if isinstance(skills, str) or not isinstance(skills, Sequence):
        raise SkillweaveError("skills must be a list of skills: skills=[Center(), ...]")
    if not skills:
        raise SkillweaveError("a hierarchy needs at least one skill: skills is empty")
    skills = [s.as_skill() if isinstance(s, Nestable) else s for s in skills]
    for skill in skills:
        if not isinstance(skill, Skill):
            hint = " (write Center(), not Center)" if isinstance(skill, type) else ""
            raise SkillweaveError(f"skills holds {short(skill)}, which is not a Skill{hint}")
        skill.validate()
        check_algorithm(skill.algorithm, f"skill {skill.name!r}: algorithm", optional=True)
        check_target(skill)
        if inner_of(skill) is None and ready_policy(skill) is not None:  # says if it cannot act
            _check_untrained(skill)
    names = [s.name for s in skills]
    for name in names:
        if names.count(name) > 1:
            raise SkillweaveError(
                f"two skills are named {name!r}; give one another name: class attribute 'name'"
            )
        if alike := [k for k in names if k != name and k.lower() == name.lower()]:
            raise SkillweaveError(
                f"the skills {name!r} and {alike[0]!r} differ in case alone, and some file systems "
                "take their files for one; give one another name: class attribute 'name'"
            )
        if name.lower() in reserved:
            raise SkillweaveError(f"a skill cannot be named {name!r}, which names a stage")
    return tuple(skills)


_OF_TRAINING = ("algorithm", "steps", "task_weight", "target_return", "target_success")
"""Attributes of a skill that say how it is trained."""


def _check_untrained(skill: Skill) -> None:
    """Raise a SkillweaveError where a skill with a policy says how it is to be trained.

    A policy that is given later (to the object of a class, or in a subclass) takes the place of a
    training: what was said of it before is no mistake.
    """
    given = _distance(skill, "policy")
    ignored = [
        field
        for field in _OF_TRAINING
        if getattr(skill, field) is not None and _distance(skill, field) <= given
    ]
    if ignored:
        fields = " and ".join(ignored)
        how = f"leave out {fields}"
        if not given:  # perhaps a function has made the object and set them
            how += f" (or set them to None: {', '.join(f'skill.{f} = None' for f in ignored)})"
        raise SkillweaveError(
            f"skill {skill.name!r} has a policy, so it is not trained, and its {fields} would be "
            f"ignored: {how}, or leave out policy to train it. What another run of "
            "Skillweave has learnt can be trained further: leave out policy, and "
            f"train(start_from={{{skill.name!r}: run}})"
        )


def _distance(skill: Skill, field: str) -> int:
    """Return the place of a skill's field: 0 on the object, 1 in its class, more in those above."""
    places = [vars(skill), *map(vars, type(skill).__mro__)]
    return next((i for i, names in enumerate(places) if field in names), len(places))


def checked_reflexes(reflexes: object) -> tuple[Reflex, ...]:
    """The reflexes, if they are a list of them.

    Raises:
        SkillweaveError: they are not.
    """
    if isinstance(reflexes, str) or not isinstance(reflexes, Sequence):
        raise SkillweaveError(
            f"reflexes is {short(reflexes)}; it must be a list: reflexes=[Reflex(...)]"
        )
    for reflex in reflexes:
        if not isinstance(reflex, Reflex):
            raise SkillweaveError(
                f"reflexes holds {short(reflex)}, which is not a Reflex: Reflex(condition, action)"
            )
    return tuple(reflexes)


def check_calls(call_steps: object, skills: Sequence[Skill]) -> None:
    """Raise a SkillweaveError where calls of skills would never end, or no length is given."""
    if isinstance(call_steps, Lengths):
        return
    if call_steps is not None:
        if type(call_steps) is not int or call_steps < 1:
            raise SkillweaveError(
                f"call_steps is {short(call_steps)}; it must be at least 1, Lengths(1, ..., 128), "
                "or None"
            )
        return
    for skill in skills:
        if not (skill.max_steps or skill.call_steps or skill.defines("termination")):
            raise SkillweaveError(
                f"call_steps is None, but skill {skill.name!r} never stops by itself: give it "
                "max_steps or termination()"
            )


def check_target(skill: Skill) -> Target | None:
    """The target of a skill's stage.

    Raises:
        SkillweaveError: it is no number in its range, or asks for a success that is not defined.
    """
    where = f"skill {skill.name!r}"
    target = target_of(skill.target_return, skill.target_success, where)
    if target is not None and target.of == "success" and not skill.defines("success"):
        raise SkillweaveError(
            f"{where} has a target_success, but does not say what success is: define success()"
        )
    return target
