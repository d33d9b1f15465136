"""A behaviour tree as a policy over skills, evaluated for all environments at once.

Stands alone because ``tree`` is the declaration, which users import.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from skillweave.errors import DeclarationError, SkillError
from skillweave.policies.core import CallEnd, LastCall, observed
from skillweave.selectors.base import (
    ReadySelector,
    goal_as_json,
    goals_at,
    skill_and_goal,
)
from skillweave.selectors.tree import Composite, Condition, Node, Status
from skillweave.skills.answers import answer
from skillweave.skills.foreign_policy import checksum, made_up
from skillweave.types import Array, Memory, Step


class TreeSelector(ReadySelector):
    """A behaviour tree as a policy over skills.

    Memory rows: ``leaf`` (the leaf of the last call, −1: none), ``succeeded`` (bool, that call
    succeeded), ``child`` (n, C) (the running child of each sequence and fallback).

    Raises:
        DeclarationError: the tree has no skill.
        SkillError: when it acts: the tree ends without a skill.
    """

    kind = "tree"

    def __init__(self, root: Composite) -> None:
        super().__init__("tree")
        self.root = root
        self._plan = _Plan()
        self._top = self._plan.add(root, lambda name: 0)
        if not self._plan.skills:
            raise DeclarationError(
                "the tree has no skill: give at least one skill's name as a child"
            )

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the skills of these names."""
        selector = super().among(skills)
        selector._plan = _Plan()
        selector._top = selector._plan.add(
            self.root, lambda name: selector._number(name, "tree: a leaf")
        )
        return selector

    @property
    def ranges(self) -> dict[str, range]:
        """Return the range of its leaves, with −1 for none."""
        return {"leaf": range(-1, len(self._plan.skills))}

    @property
    def gives_goals(self) -> bool:
        """Return whether a leaf gives its skill a goal."""
        return bool(self._plan.goals)

    def start(self, n: int) -> Memory:
        """Return a memory without a running call."""
        return {
            "leaf": np.full(n, -1),
            "succeeded": np.zeros(n, bool),
            "child": np.zeros((n, self._plan.composites), np.int64),
        }

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return the skill of the leaf that each environment's tree runs, (n,)."""
        n = len(obs)
        mask = np.ones((n, len(self.skills)), bool) if mask is None else mask
        tick = _Tick(obs, mask, memory, self._who)
        status = self._top.tick(tick, np.arange(n))
        again = np.flatnonzero(status != Status.RUNNING)
        if len(again):  # the whole tree is over: it starts again
            tick.begin(again)
            status[again] = self._top.tick(tick, again)
        if (status != Status.RUNNING).any():
            row = int(np.flatnonzero(status != Status.RUNNING)[0])
            raise SkillError(
                f"{self._who} ended ({Status(int(status[row])).name}) in observation "
                f"{observed(obs[row])} without a skill that may start there: add a Fallback whose "
                "last child is a skill that may start everywhere"
            )
        after = {"leaf": tick.leaf, "succeeded": tick.succeeded, "child": tick.after}
        if not self._plan.goals and not self.goal_spaces:
            return tick.skill, after
        return self.with_goals(tick.skill, self._goals_of(tick.leaf, obs), obs), after

    def _goals_of(self, leaf: Array, obs: Array) -> dict[str, tuple[Array, Any]]:
        """Return the goals of the running leaves (n,), with their rows, by skill."""
        found: dict[str, list[tuple[Array, Any]]] = {}
        for number, goal in self._plan.goals.items():
            rows = np.flatnonzero(leaf == number)
            if len(rows):
                name = self.skills[self._plan.skills[number]]
                who = f"{self._who}: the goal of {name!r}"
                values = goals_at(goal, self.goal_spaces.get(name), obs[rows], who)
                found.setdefault(name, []).append((rows, values))
        return {name: self._joined_goals(name, parts) for name, parts in found.items()}

    def watch(self, memory: Memory, step: Step, last: LastCall) -> Memory:
        """Store whether the running call has succeeded.

        If a policy that the tree only guides called another skill than the leaf's, the leaf did not
        run: it is evaluated again.
        """
        over = last.why != CallEnd.RUNNING
        called = np.array(self._plan.skills)[memory["leaf"]] == last.skill
        leaf = np.where(over & ~called, -1, memory["leaf"])
        succeeded = np.where(over, last.succeeded, memory["succeeded"])
        return memory | {"leaf": leaf, "succeeded": succeeded}

    def try_out(self) -> None:
        """Evaluate every condition once on two example observations."""
        obs = made_up(self.observation_space, 2)
        tick = _Tick(obs, np.ones((2, 1), bool), self.start(2), self._who)
        for node in self._plan.conditions:
            node.tick(tick, np.arange(2))

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


class _Tick:
    """One evaluation of the tree for n environments, at a decision."""

    def __init__(self, obs: Array, mask: Array, memory: Memory, name: str) -> None:
        self.obs = obs
        self.mask = mask
        self.name = name
        self.leaf = memory["leaf"].copy()
        self.succeeded = memory["succeeded"]
        self.before = memory["child"].copy()
        # Zeros: nodes that this evaluation does not reach are no longer running.
        self.after = np.zeros_like(self.before)
        self.skill = np.zeros(len(obs), np.int64)

    def begin(self, rows: Array) -> None:
        """Restart environments ``rows`` at the root, without a running call."""
        self.leaf[rows] = -1
        self.before[rows] = self.after[rows] = 0


@dataclass(frozen=True)
class _Leaf:
    number: int
    skill: int

    def tick(self, tick: _Tick, rows: Array) -> Array:
        """Return the end of its call, if that was the last one; else start its call."""
        over = tick.leaf[rows] == self.number
        status = np.where(tick.succeeded[rows], Status.SUCCESS, Status.FAILURE)
        fresh = ~over
        starts = tick.mask[rows, self.skill]
        status[fresh] = np.where(starts[fresh], Status.RUNNING, Status.FAILURE)
        begins = rows[fresh & starts]
        tick.leaf[begins] = self.number
        tick.skill[begins] = self.skill
        return status


@dataclass(frozen=True)
class _Check:
    condition: Condition

    def tick(self, tick: _Tick, rows: Array) -> Array:
        """Return the condition's status for the observations."""
        function = self.condition.function
        name = self.condition.name
        holds = answer(function, tick.obs[rows], len(rows), bool, tick.name, name)
        return np.where(holds, Status.SUCCESS, Status.FAILURE)


@dataclass(frozen=True)
class _Several:
    number: int
    memory: bool
    goes_on_after: Status
    children: tuple[_Several | _Check | _Leaf, ...]

    def tick(self, tick: _Tick, rows: Array) -> Array:
        """Evaluate the children in turn, until one of them decides."""
        status = np.full(len(rows), self.goes_on_after)
        first = tick.before[rows, self.number] if self.memory else np.zeros(len(rows), np.int64)
        for i, child in enumerate(self.children):
            reached = np.flatnonzero((status == self.goes_on_after) & (first <= i))
            if len(reached):
                status[reached] = child.tick(tick, rows[reached])
                running = reached[status[reached] == Status.RUNNING]
                tick.after[rows[running], self.number] = i
        return status


@dataclass
class _Plan:
    """The nodes of a tree with numbers, so that memories can be arrays."""

    skills: list[int] = field(default_factory=list)  # of each leaf
    composites: int = 0
    conditions: list[_Check] = field(default_factory=list)
    goals: dict[int, Any] = field(default_factory=dict)  # by leaf, where its skill has goals

    def add(self, node: Node, number_of: Callable[[str], int]) -> Any:
        """Return a node with all below it."""
        if isinstance(node, Condition):
            self.conditions.append(_Check(node))
            return self.conditions[-1]
        if isinstance(node, str | tuple):
            name, goal = skill_and_goal(node)
            if goal is not None:
                self.goals[len(self.skills)] = goal
            self.skills.append(number_of(name))
            return _Leaf(len(self.skills) - 1, self.skills[-1])
        self.composites += 1
        number = self.composites - 1
        children = tuple(self.add(child, number_of) for child in node.children)
        return _Several(number, node.memory, node.goes_on_after, children)
