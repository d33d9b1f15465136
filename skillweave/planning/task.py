"""Every kind of task in one form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skillweave.errors import DeclarationError
from skillweave.messages import short
from skillweave.planning.goal import GoalTask
from skillweave.planning.machine import RewardMachine
from skillweave.planning.mission import Mission
from skillweave.planning.parts import AnyOrder, Choice
from skillweave.planning.predicates import Held, Predicate

Task = RewardMachine | GoalTask


def as_task(value: Any, predicates: Mapping[str, Any] | None = None) -> Task:
    """Return a task of any value that means one.

    Args:
        value: a ``RewardMachine``, a ``Mission`` or its text, a ``GoalTask``, a predicate (the task
            is done where it holds), also a function of observations, or a function of a ``Step``:
            the reward.
        predicates: by name, for texts.

    Raises:
        DeclarationError: the value is none of these.
    """
    if isinstance(value, RewardMachine | GoalTask):
        return value
    if isinstance(value, str):
        return Mission.from_text(value, predicates or {})
    if isinstance(value, Predicate | Held | Choice | AnyOrder):
        return Mission(value)
    if callable(value) and not isinstance(value, type):
        predicate = Predicate(value)
        return (
            Mission(predicate) if predicate.reads == "obs" else RewardMachine({}, each_step=value)
        )
    raise DeclarationError(
        f"the task is {short(value)}; give a Mission or its text, a RewardMachine, a GoalTask, or "
        "a function of a step that returns the reward"
    )
