"""Checks of a declared hierarchy: its skills, the settings of each level, and nesting."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from skillweave._internal.messages import short, suggest
from skillweave._internal.notices import notice
from skillweave._internal.paths import name_of
from skillweave.algorithms.config import PPO, AlgorithmSettings
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.hierarchy.roles import Level, Nestable, Roles
from skillweave.hierarchy.settings import USUAL_CALL_STEPS, Guide
from skillweave.runs.manifest import Target
from skillweave.schema import fitted
from skillweave.skills import Automaton, Skill, ready_policy
from skillweave.skills.base import RecordedSkill, is_trained
from skillweave.skills.learnable import learn_on
from skillweave.skills.lengths import Lengths
from skillweave.skills.own_part import ZERO, checked_rest
from skillweave.training.stage import target_of


def checked_skills(skills: object, reserved: Collection[str]) -> tuple[Skill, ...]:
    """Check declared skills; return them as a tuple, each hierarchy among them as a skill.

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
        inside = isinstance(skill.policy, Nestable)
        if not inside and ready_policy(skill) is not None:  # raises if it cannot act
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
            f"ignored: {advice}, or leave out policy to train it. To let it learn on, "
            f"{learn_on(skill.name)}"
        )


def _distance(skill: Skill, field: str) -> int:
    """Return how far a skill's setting is declared: 0 on the object, 1 in its class, more above."""
    places = [vars(skill), *map(vars, type(skill).__mro__)]
    return next((i for i, names in enumerate(places) if field in names), len(places))


def check_level(level: Level) -> None:
    """Raise a DeclarationError where the settings of a hierarchy do not fit together."""
    _check_selection(level)
    _check_calls(level)
    _check_start_calls(level)
    _check_rest(level)
    _check_fades(level)


def _check_selection(level: Level) -> None:
    """Raise a DeclarationError where selector, guide and way of learning do not fit together."""
    ready = level.ready_selector
    for some in (ready, level.ready_guide):
        if some is not None and some.lengths and some.lengths != level.lengths:
            raise DeclarationError(
                f"the {some.name} chooses the lengths {', '.join(map(str, some.lengths))}, so "
                f"write call_steps=Lengths({', '.join(map(str, some.lengths))})"
            )
    if ready is None:
        if level.guide is not None:
            _check_guide(level, level.guide)
        return
    refused = {
        "selection.target_return is given": level.selection.target_return is not None,
        "together.interrupt is True": level.together.interrupt,
        "call_steps are Lengths": isinstance(level.call_steps, Lengths) and not ready.lengths,
        "a guide is given": level.guide is not None,
    }
    for setting, is_set in refused.items():
        if is_set:
            raise DeclarationError(f"{setting}, but the selector is ready: it does not learn")


def _check_guide(level: Level, guide: Guide) -> None:
    """Raise a DeclarationError where a guide could not guide."""
    ready = level.ready_guide  # raises if one of its skills does not exist
    guide_chooses_lengths = ready is not None and bool(ready.lengths)
    learns_by = type(level.selector).__name__
    if guide.target_kl is not None and not isinstance(level.selector, PPO):
        raise DeclarationError(
            f"the guide's target_kl is {guide.target_kl:g}, but the selector learns by "
            f"{learns_by}: only PPO can be kept near a guide"
        )
    if not guide.restrict or isinstance(guide.selector, Automaton):
        pass
    elif not isinstance(level.call_steps, Lengths) or guide_chooses_lengths:
        raise DeclarationError(
            "the guide names one skill at each decision, so a selector that it restricts has "
            "nothing to choose: write Guide(..., restrict=False, target_kl=0.1), or let the "
            "selector choose lengths, or give an Automaton whose states have several skills"
        )
    elif not isinstance(level.selector, PPO):
        raise DeclarationError(
            f"a selector that learns by {learns_by} needs the "
            "skills allowed next, which a function or a tree returns only at decisions: give an "
            "Automaton, or use PPO"
        )
    if guide.restrict and level.together.interrupt:
        raise DeclarationError(
            "together.interrupt is True, but the guide restricts which skill may be called "
            "instead: give one of them"
        )


def _check_calls(level: Level) -> None:
    """Raise a DeclarationError where calls of skills would never end.

    Give a notice where a skill that ends itself seems to have no limit, and has the usual one.
    """
    if level.call_steps is not None:
        for skill in level.skills.values():
            if level.call_steps == USUAL_CALL_STEPS and _undoes_call_steps(skill):
                notice(
                    f"skill {skill.name!r}: call_steps = None lifts no limit of its calls: "
                    f"it means the hierarchy's call_steps, {level.call_steps}. For calls that last "
                    "until the skill ends them, give it a large number, call_steps = 10_000, or "
                    "leave call_steps out to end this message"
                )
        return
    for skill in level.skills.values():
        if not (skill.max_steps or skill.call_steps or skill.defines("termination")):
            raise DeclarationError(
                f"call_steps is None, but skill {skill.name!r} never ends by itself: give it "
                "max_steps or termination()"
            )


def _check_fades(level: Level) -> None:
    """Raise a DeclarationError where a skill fades in after one that is not there, or learns."""
    names = [skill.name for skill in level.skills.values()]
    for skill in level.skills.values():
        if skill.fade is None:
            continue
        where = f"skill {skill.name!r}: fade"
        if is_trained(skill) and not isinstance(skill, RecordedSkill):
            raise DeclarationError(
                f"{where} is {short(skill.fade)}, but the skill learns, and its actions would not "
                "be its own: only a ready skill can fade in"
            )
        for name in skill.fade if isinstance(skill.fade, Mapping) else ():
            if name not in names or name == skill.name:
                others = [other for other in names if other != skill.name]
                raise DeclarationError(f"{where} names {short(name)}{suggest(name, others)}")


def _undoes_call_steps(skill: Skill) -> bool:
    """Return whether a skill's class has both a termination and call_steps = None.

    A None that takes back the number of a class above is meant so.
    """
    kinds = type(skill).__mro__
    said = [vars(kind)["call_steps"] for kind in kinds if "call_steps" in vars(kind)]
    only_none = len(said) > 1 and not any(said) and skill.call_steps is None
    return only_none and skill.defines("termination")


def _check_rest(level: Level) -> None:
    """Raise a DeclarationError where ``rest`` is wrong, or means nothing."""
    checked_rest(level.rest)
    is_default = isinstance(level.rest, str) and level.rest == ZERO
    if not is_default and all(skill.acts is None for skill in level.skills.values()):
        raise DeclarationError(
            f"rest is {short(level.rest)}, but no skill writes a part of the action alone: give a "
            "skill acts, the part that it writes, or leave out rest"
        )


def _check_start_calls(level: Level) -> None:
    """Raise a DeclarationError where ``apart.start_calls`` names no skill of the level."""
    calls = level.apart.start_calls
    for name in calls if isinstance(calls, tuple) else ():
        if name not in level.names:
            raise DeclarationError(
                f"apart.start_calls names {short(name)}, which is no skill here"
                f"{suggest(name, level.names)}"
            )


_ELSEWHERE = {
    **dict.fromkeys(("sees", "acts"), "it to the skills in the hierarchy"),
    "algorithm": "the hierarchy selector=",
    "steps": "the hierarchy steps=",
    **dict.fromkeys(
        ("target_return", "target_success"),
        "the hierarchy selection=Selection(target_return=...)",
    ),
}
"""Attributes of a skill that one which is a hierarchy does not have, and what to give instead."""


def check_nested(roles: Roles) -> None:
    """Raise a DeclarationError where a hierarchy cannot be a skill of another one.

    Afterwards messages call every skill by its path.
    """
    for path, level in roles.levels.items():
        if path:
            _check_same_env(name_of(path), level.spec, roles.spec)
    for path, skill in roles.skills.items():
        skill._path = path
        if path not in roles.levels:
            continue
        if isinstance(getattr(type(skill), "policy", None), property):
            raise DeclarationError(
                f"skill {path!r} is a hierarchy, but its policy is a property: make it a class "
                "attribute"
            )
        for field, advice in _ELSEWHERE.items():
            if getattr(skill, field) is not None:
                raise DeclarationError(
                    f"skill {path!r} is a hierarchy, so it has no {field} of its own: give {advice}"
                )


def _check_same_env(name: str, spec: EnvSpec, other: EnvSpec) -> None:
    """Raise a DeclarationError where the hierarchy ``name`` is on another environment."""
    # The outermost hierarchy sets the number of processes for all.
    if replace(spec, workers=None) == replace(other, workers=None):
        return
    same = spec.name == other.name
    mine, theirs = (short(x) if same else x.name for x in (spec, other))
    raise DeclarationError(
        f"{name}: this hierarchy is a skill of another one, so both act in the same "
        f"environment; but it is declared on {mine}, and the other on {theirs}"
    )


def check_target(skill: Skill) -> Target | None:
    """Check a declared skill's target, and return it as that of its stage.

    Raises:
        DeclarationError: the skill has two targets, or has one of success without success().
    """
    where = f"skill {skill.name!r}"
    target = target_of(skill.target_return, skill.target_success, where)
    if target is not None and target.of == "success" and not skill.defines("success"):
        raise DeclarationError(f"{where} has a target_success, but no success(): define success()")
    return target
