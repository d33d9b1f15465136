"""What a call of a skill is for: when it counts as done."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skillweave._internal.messages import error_text, short, suggest
from skillweave.calls.predicates import Predicate, as_predicate
from skillweave.errors import DeclarationError, SkillError
from skillweave.policies.core import Step
from skillweave.skills import Skill


@dataclass(frozen=True)
class Aim:
    """What has to be true of a call of one skill; None: it is not asked."""

    skill: Skill
    stays: Predicate | None = None
    """In each step of the whole call."""
    done: Predicate | None = None
    """In some step of it."""
    follows: Callable[[Step], Any] | None = None
    """Of all its steps together: what was asked for is followed."""

    @property
    def by_success(self) -> bool:
        """True if the skill's own ``success`` decides."""
        return self.stays is None and self.done is None

    def holds(self, predicate: Predicate, step: Step) -> bool:
        """Return whether a predicate is true after a step of one environment."""
        return bool(predicate.holds(step)[0])

    def succeeds(self, step: Step) -> bool:
        """Return whether the skill's own ``success`` is true after a step of one environment."""
        return self.holds(Predicate(self.skill.success, f"{self.skill.name}.success", "step"), step)

    def is_followed(self, steps: Sequence[Step]) -> bool:
        """Return whether a call of these steps, of one environment each, did what was asked.

        Raises:
            SkillError: ``follows`` failed, or returned neither True nor False.
        """
        if self.follows is None:
            return True
        who = f"follows, of the skill {self.skill.name!r}"
        try:
            answer = self.follows(joined(steps))
        except Exception as error:
            raise SkillError(f"{who} raised {error_text(error)}") from error
        if isinstance(answer, np.ndarray) and answer.size == 1:
            answer = answer.reshape(-1)[0]
        if not isinstance(answer, bool | np.bool_):
            raise SkillError(
                f"{who} returned {short(answer)}; it is given a Step with a row for each step of "
                "the call, and must return one True or False"
            )
        return bool(answer)


def aims_of(
    skills: Sequence[Skill], stays: Any = None, done: Any = None, follows: Any = None
) -> list[Aim]:
    """Return the aim of each skill.

    Args:
        stays, done, follows: one for all skills, or by skill.

    Raises:
        DeclarationError: a name is unknown, a value is no function, or nothing says when a skill's
            call is done.
    """
    names = [skill.name for skill in skills]
    asked = {"stays": stays, "done": done, "follows": follows}
    by_skill = {key: _by_skill(value, names, key) for key, value in asked.items()}
    aims = []
    for skill in skills:
        own = {key: values.get(skill.name) for key, values in by_skill.items()}
        for key in ("stays", "done"):
            if own[key] is not None:
                own[key] = as_predicate(own[key], f"{key} of {skill.name!r}")
        if own["follows"] is not None and not callable(own["follows"]):
            raise DeclarationError(
                f"follows of {skill.name!r} is {short(own['follows'])}; give a function of a "
                "call's steps, a Step, that returns True or False"
            )
        aim = Aim(skill, **own)
        if aim.by_success and not skill.defines("success"):
            raise DeclarationError(
                f"nothing says when a call of {skill.name!r} is done: give stays=, a function of "
                "observations that must hold in each step of a call (the robot is upright, for "
                "example), or done=, one that must hold in some step"
            )
        aims.append(aim)
    return aims


def _by_skill(value: Any, names: Sequence[str], key: str) -> Mapping[str, Any]:
    """Return one value for all skills, or values by skill, by name."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        return dict.fromkeys(names, value)
    for name in value:
        if name not in names:
            raise DeclarationError(f"{key} names {short(name)}, no skill{suggest(name, names)}")
    return value


def joined(steps: Sequence[Step]) -> Step:
    """Return a call's steps, of one environment each, as one ``Step`` with a row for each."""

    def rows(name: str) -> Any:
        return np.concatenate([getattr(step, name) for step in steps])

    arrays = ("obs", "action", "next_obs", "reward", "terminated", "truncated", "timed_out")
    known = set.intersection(*(set(step.info) for step in steps))
    info = {
        key: np.concatenate([np.asarray(step.info[key]) for step in steps])
        for key in sorted(known)
        if all(np.shape(step.info[key])[:1] == (1,) for step in steps)
    }
    return Step(**{name: rows(name) for name in arrays}, elapsed=rows("elapsed"), info=info)
