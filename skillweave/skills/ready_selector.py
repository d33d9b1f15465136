"""Functions and behaviour trees as selectors: values of a hierarchy's ``selector``, converted."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

from skillweave.errors import DeclarationError
from skillweave.policies import selectors
from skillweave.policies.core import LastCall
from skillweave.policies.files import checksum
from skillweave.policies.selectors import Asked, Branch, Check, Leaf, function_name, skill_and_goal
from skillweave.skills.foreign_policy import made_up, qualified
from skillweave.skills.outputs import Wrapped, called, required_arguments
from skillweave.skills.probing import probe
from skillweave.skills.selector import ReadySelector, checked_function, goal_as_json
from skillweave.skills.tree import Composite, Condition, Node, Sequence
from skillweave.types import Array

ReadyValue = Callable[..., Any] | ReadySelector | Composite
"""A function of observations, an automaton or another ready selector, or a behaviour tree."""


def ready_selector(value: Any, skills: tuple[str, ...]) -> ReadySelector | None:
    """Convert ``value`` to a selector among skills of these names; None: it is not one.

    Raises:
        DeclarationError: it names another skill.
    """
    selector: ReadySelector
    if isinstance(value, ReadySelector):
        selector = value
    elif isinstance(value, Composite):
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


class TreeSelector(ReadySelector):
    """A behaviour tree as a policy over skills; see ``policies.selectors.Tree``.

    Raises:
        DeclarationError: the tree has no skill.
        SkillError: when it acts: the tree ends without a skill.
    """

    kind = "tree"

    def __init__(self, root: Composite) -> None:
        super().__init__("tree")
        self.root = root
        if not list(self.named()):
            raise DeclarationError(
                "the tree has no skill: give at least one skill's name as a child"
            )

    def named(self) -> Iterator[tuple[str, str, Any]]:
        """Yield the skills of all leaves, with their goals."""
        nodes: list[Node] = [self.root]
        while nodes:
            node = nodes.pop(0)
            if isinstance(node, Composite):
                nodes[:0] = node.children
            elif not isinstance(node, Condition):
                yield "a leaf", *skill_and_goal(node)

    @cached_property
    def in_place(self) -> selectors.Tree:  # type: ignore[override]
        """The rule that acts."""
        return selectors.Tree(*self._rule_of, self._node(self.root))

    def _node(self, node: Node) -> selectors.Node:
        if isinstance(node, Condition):
            return Check(node.name, checked_function(node.function, self._who, node.name))
        if isinstance(node, Composite):
            children = tuple(map(self._node, node.children))
            return Branch(
                "Sequence" if isinstance(node, Sequence) else "Fallback", children, node.memory
            )
        name, goal = skill_and_goal(node)
        return Leaf(name, None if goal is None else self._goal(name, goal, self._who))

    def try_out(self) -> None:
        """Evaluate every condition once on two example observations."""
        obs = made_up(self.observation_space, 2)
        for condition in self.in_place.checks:
            condition.function(obs)

    def source(self) -> dict[str, Any]:
        """Return the checksum of its nodes, with only the names of functions."""
        whole = json.dumps(_as_json(self.root))
        return {"kind": self.kind, "name": self.name, "sha256": checksum(whole.encode())}


def _as_json(node: Node) -> Any:
    """Return a node as JSON."""
    if isinstance(node, str):
        return node
    if isinstance(node, tuple):
        return [node[0], goal_as_json(node[1])]
    if isinstance(node, Condition):
        return {"condition": node.name}
    return {type(node).__name__: [_as_json(c) for c in node.children], "memory": node.memory}
