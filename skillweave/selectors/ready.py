"""Values of the attribute ``selector`` of a hierarchy, converted to ready selectors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from skillweave.policies.core import LastCall
from skillweave.policies.selectors import Asked
from skillweave.selectors import tree
from skillweave.selectors.base import ReadySelector, Wrapped, function_name
from skillweave.selectors.tree_policy import TreeSelector
from skillweave.skills.foreign_policy import qualified
from skillweave.skills.outputs import called, required_arguments
from skillweave.skills.probing import probe
from skillweave.types import Array

ReadyValue = Callable[..., Any] | ReadySelector | tree.Composite
"""A function of observations, an automaton or another ready selector, or a behaviour tree."""


def ready_selector(value: Any, skills: tuple[str, ...]) -> ReadySelector | None:
    """Convert ``value`` to a selector among skills of these names; None: it is not one.

    Raises:
        DeclarationError: it names another skill.
    """
    selector: ReadySelector
    if isinstance(value, ReadySelector):
        selector = value
    elif isinstance(value, tree.Composite):
        selector = TreeSelector(value)
    elif callable(value) and not isinstance(value, type):
        selector = FunctionSelector(value)
    else:
        return None
    return selector.among(skills)


class FunctionSelector(ReadySelector):
    """A function from observations (n, *obs_shape) to skills (n,): names, or places in the list.

    If it needs a second argument, that is the ``LastCall``. Where skills have goals, it returns
    skills and goals: ``(names, goals)``, the goals (n, *goal_shape), or a dict of such goals by
    skill where several have some. They count where the skill is chosen.

    Raises:
        SkillError: when it acts: the function failed, or chose an unknown skill, or a skill that
            may not start.
    """

    kind = "function"

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(f"function {function_name(function)}()")
        self.function = function

    @cached_property
    def in_place(self) -> Asked:  # type: ignore[override]
        """The rule that acts."""
        asks_last = required_arguments(self.function) > 1
        return Asked(*self._rule_of, Wrapped(self.function, self._ask), asks_last)

    def _ask(self, obs: Array, *last: LastCall) -> Any:
        value = called(self.function, obs, self._who, more=last)
        if self.in_place.parted(value, len(obs))[1] is None:
            probe(self.function, (obs, *last), self._who)
        return value

    def source(self) -> dict[str, Any]:
        """Return the function's name."""
        return {"kind": self.kind, "name": qualified(self.function)}
