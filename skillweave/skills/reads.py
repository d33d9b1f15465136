"""Search for what the methods of a skill read of a step: keys of ``info``, and the goal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.skills.base import Skill, path_of
from skillweave.skills.outputs import called
from skillweave.skills.probing import first_time, untouched
from skillweave.types import Step


class _Recording(dict[Any, Any]):
    """An info that notes which of its keys are read."""

    def __init__(self, info: Any) -> None:
        super().__init__(info)
        self.read: dict[Any, None] = {}
        self.whole = False
        """True if something went over all keys."""


def _noting(name: str, whole: bool) -> Callable[..., Any]:
    method = getattr(dict, name)

    def noting(self: _Recording, *arguments: Any) -> Any:
        self.whole |= whole
        self.read.update(dict.fromkeys(arguments[:1]))
        return method(self, *arguments)

    return noting


for _name in ("__iter__", "keys", "values", "items", "copy"):
    setattr(_Recording, _name, _noting(_name, True))
for _name in ("__getitem__", "__contains__", "get"):
    setattr(_Recording, _name, _noting(_name, False))

JUDGING = ("reward", "termination", "success")
"""Methods that receive a step."""


def _call(skill: Skill, method: str, step: Step) -> str:
    """Call a method of a skill without traces, and return its name for messages."""
    who = f"skill {path_of(skill)!r}: {method}()"
    with untouched(skill):
        called(getattr(skill, method), step, who, judges=None)
    return who


def info_keys_read(skill: Skill, step: Step, methods: Sequence[str] = JUDGING) -> tuple[str, ...]:
    """Return the keys of ``info`` that a skill's methods read, found by calling them.

    A key that is read only sometimes may not be found: a skill names it in ``needs_info``, which
    replaces the search.

    Args:
        step: n steps of the environment.
        methods: of the skill.

    Raises:
        DeclarationError: a method goes over the whole info, so ``needs_info`` must say what it
            needs.
    """
    if skill.needs_info is not None:
        return tuple(skill.needs_info)
    found: dict[str, None] = {}
    for method in filter(skill.defines, methods):
        info = _Recording(step.info)
        who = _call(skill, method, replace(step, info=info))
        if info.whole:
            raise DeclarationError(
                f"{who} reads info as a whole, so it cannot be found out which keys to record "
                "for it: name them in the class, needs_info = ('key', ...)"
            )
        found |= {key: None for key in info.read if isinstance(key, str)}
    return tuple(found)


class _Watched(Step):
    """A step that notes whether its goal is read."""

    reads = False

    @property
    def goal(self) -> Any:
        """Return the goal, and note that it was read."""
        self.reads = True
        return self._goal

    @goal.setter
    def goal(self, value: Any) -> None:
        self._goal = value


def is_unchecked(skill: Skill) -> bool:
    """Return True once for each skill."""
    return first_time(skill, "its goal")


def check_reads_goal(skill: Skill, step: Step) -> None:
    """Give a notice where neither reward, termination nor success of a skill reads its goal.

    It would learn to ignore its goal.

    Args:
        step: some steps of the skill, with goals.
    """
    if skill.reward_changes:
        return
    watched = _Watched(**{field.name: getattr(step, field.name) for field in fields(Step)})
    watched.reads = False
    try:
        for method in filter(skill.defines, JUDGING):
            _call(skill, method, watched)
    except SkillweaveError:
        return  # it is raised where the step is judged
    if not watched.reads:
        notice(
            f"skill {path_of(skill)!r} has goals, but its reward(), termination() and success() "
            "are the same for every goal: none reads step.goal, so the skill learns to ignore its "
            "goal. Let its reward depend on step.goal, or leave out goal_space"
        )
