"""What a user may write after ``selector =`` beside an algorithm's settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skillweave.selectors import tree
from skillweave.selectors.automaton import Automaton
from skillweave.selectors.base import ReadySelector
from skillweave.selectors.function import FunctionSelector
from skillweave.selectors.tree_policy import TreeSelector

ReadyValue = Callable[..., Any] | Automaton | tree.Composite
"""A function of observations, an automaton, or a behaviour tree."""


def ready_selector(value: Any, skills: tuple[str, ...]) -> ReadySelector | None:
    """Return the selector that ``value`` means among skills of these names; None: it is none.

    Raises:
        DeclarationError: it names a skill that is not among them.
    """
    found: ReadySelector
    if isinstance(value, Automaton):
        found = value
    elif isinstance(value, tree.Composite):
        found = TreeSelector(value)
    elif callable(value) and not isinstance(value, type):
        found = FunctionSelector(value)
    else:
        return None
    return found.among(skills)
