"""Ready selectors, which choose skills without training: their base, functions and trees."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, partial
from typing import Any, Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Dict

from skillweave._internal.messages import shortened
from skillweave._internal.terminal import one_line
from skillweave.errors import DeclarationError
from skillweave.policies import selectors
from skillweave.policies.core import Array, LastCall
from skillweave.policies.functional import Functional
from skillweave.policies.parts import GOAL
from skillweave.policies.selectors import (
    Branch,
    FunctionRule,
    Leaf,
    Rule,
    TreeCondition,
    function_name,
    skill_and_goal,
)
from skillweave.policies.spaces import space_of
from skillweave.policies.untrusted import checksum
from skillweave.skills.foreign_policy import Foreign, made_up, qualified
from skillweave.skills.function_state import examples
from skillweave.skills.goal_spaces import alone
from skillweave.skills.outputs import Wrapped, call_checked, call_user, required_arguments
from skillweave.skills.tree import Composite, Condition, Node, Sequence


class ReadySelector(Functional, Foreign):
    """A selector that is not trained: a policy over skills that also observes the ends of calls.

    It is called only where a call is over. It respects the skills' initiation sets, which are its
    mask. Its whole state is its memory, with a row for each environment.
    """

    lengths: tuple[int, ...] = ()
    """The lengths of calls that it chooses with skills; empty: it chooses skills alone."""
    in_place: Any
    """The ``Rule`` that acts, whose functions are called with this library's messages.

    It is made when it is first needed, so that the skills and their goals are known; it raises a
    SkillError where a fixed goal does not fit its skill."""

    def __init__(self, name: str) -> None:
        Foreign.__init__(self, name)
        self.skills: tuple[str, ...] = ()

    def __init_subclass__(cls) -> None:
        """Refuse methods that nothing would call, as the rule acts."""
        for method in {"start", "act", "observe", "watch", "chances", "allowed"} & vars(cls).keys():
            raise DeclarationError(
                f"{cls.__name__}.{method}() would not be asked: a ready selector acts by its "
                "declaration alone. To choose in another way, give a function of observations as "
                "the selector"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes of a copy, which makes its own rule."""
        made = ("in_place", "_like")
        return {name: value for name, value in vars(self).items() if name not in made}

    def named(self) -> Iterable[tuple[str, str, Any]]:
        """Return the skills that its declaration names: where, their names and goals or None."""
        return ()

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the ``skills`` of these names, in the hierarchy's order.

        Raises:
            DeclarationError: it names another skill.
        """
        selector = copy.copy(self)
        rule = Rule(self.kind, skills, {})
        selector.skills = skills
        for where, name, _ in self.named():
            rule.number(name, f": {where}", DeclarationError)
        return selector

    def check_environment(self, spec: Any) -> None:
        """Give a notice where it was made for another environment than it acts in.

        Args:
            spec: an ``EnvSpec``, the environment in which it acts.
        """

    @property
    def goal_spaces(self) -> dict[str, Space[Any]]:
        """Return the spaces of goals of the skills that have some, by name, once it is bound."""
        space = self.action_space
        goals = space[GOAL] if isinstance(space, Dict) else None
        return dict(goals.spaces) if isinstance(goals, Dict) else {}

    @property
    def _rule_of(self) -> tuple[str, tuple[str, ...], dict[str, Any]]:
        """Return the arguments that every ``Rule`` has: who, skills and goals."""
        goals = {name: space_of(space) for name, space in self.goal_spaces.items()}
        return self._who, self.skills, goals

    def _goal(self, name: str, goal: Any, where: str) -> Any:
        """Return a goal of ``(name, goal)`` for a rule; ``where`` it is declared, for messages."""
        if callable(goal):
            return Wrapped(goal, partial(call_user, goal, who=f"{where}: the goal of {name!r}"))
        if (space := self.goal_spaces.get(name)) is None:
            return goal
        data = space_of(space)
        goals = data.goals(alone(data, goal), 1, self._who, f"skill {name!r}")
        return goals.reshape(data.shape)


def checked_function(
    function: Callable[[Any], Any], who: str, name: str, dtype: type = bool
) -> Wrapped:
    """Return a function of observations or of steps to (n,), whose answers are checked."""
    return Wrapped(function, partial(call_checked, function, dtype=dtype, who=f"{who}: {name}()"))


def goal_as_json(goal: Any) -> Any:
    """Return a goal of ``(name, goal)`` for checksums; of a function its name."""
    if callable(goal):
        return {"function": function_name(goal)}
    return repr(goal.tolist() if isinstance(goal, np.ndarray) else goal)


def listed(names: tuple[str, ...]) -> str:
    """Join names to a part of a sentence."""
    return shortened(one_line(", ".join(names)), 300)


# Functions and trees ---------------------------------------------------------------------------

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
    """A declared selector: a user's function of observations (n, *obs_shape) to skills (n,).

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
    def in_place(self) -> FunctionRule:  # type: ignore[override]
        """The rule that acts."""
        asks_last = required_arguments(self.function) > 1
        return FunctionRule(*self._rule_of, Wrapped(self.function, self._ask), asks_last)

    def _ask(self, obs: Array, *last: LastCall) -> Any:
        """Call the user's selector function; return skills, and goals if it gives some."""

        def convert(value: Any) -> Any:
            self.in_place.parted(value, len(obs))
            return value

        return call_user(self.function, obs, self._who, more=last, convert=convert)

    def source(self) -> dict[str, Any]:
        """Return the function's name."""
        return {"kind": self.kind, "name": qualified(self.function)}


class TreeSelector(ReadySelector):
    """A declared behaviour tree as a selector; see ``policies.selectors.Tree``.

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
        """Return a declared node of a behaviour tree as the one that acts."""
        if isinstance(node, Condition):
            return TreeCondition(node.name, checked_function(node.function, self._who, node.name))
        if isinstance(node, Composite):
            children = tuple(map(self._node, node.children))
            return Branch(
                "Sequence" if isinstance(node, Sequence) else "Fallback", children, node.memory
            )
        name, goal = skill_and_goal(node)
        return Leaf(name, None if goal is None else self._goal(name, goal, self._who))

    def try_out(self) -> None:
        """Evaluate every condition once on two examples of observations."""
        obs = made_up(self.observation_space, 2)
        for condition in self.in_place.checks:
            with examples(condition.function.bare):
                condition.function(obs)

    def source(self) -> dict[str, Any]:
        """Return the checksum of its nodes, with only the names of functions."""
        whole = json.dumps(_as_json(self.root))
        return {"kind": self.kind, "name": self.name, "sha256": checksum(whole.encode())}


def _as_json(node: Node) -> Any:
    """Return a node of a declared behaviour tree as JSON."""
    if isinstance(node, str):
        return node
    if isinstance(node, tuple):
        return [node[0], goal_as_json(node[1])]
    if isinstance(node, Condition):
        return {"condition": node.name}
    return {type(node).__name__: [_as_json(c) for c in node.children], "memory": node.memory}
