"""Values of the attribute ``selector`` of a hierarchy, converted to ready selectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skillweave.selectors import tree
from skillweave.selectors.base import ReadySelector
from skillweave.selectors.function import FunctionSelector
from skillweave.selectors.tree_policy import TreeSelector

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
