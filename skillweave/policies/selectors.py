"""Selectors that are rules: a function of observations, an automaton, or a behaviour tree."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Literal

import numpy as np

from .acting_errors import PolicyError, SkillError, SkillweaveError
from .core import (
    EPISODE,
    RUNNING,
    Array,
    LastCall,
    Memory,
    Step,
    Turn,
    World,
    call_plainly,
    code,
    observed,
    put,
    read_only,
    take,
)
from .hierarchy import SKILL
from .leaves import Selector
from .parts import GOAL
from .spaces import Space, discrete
from .untrusted import shown


@dataclass(eq=False)
class Rule(Selector):
    """The rule of a ready selector as it acts: it chooses skills, and goals for some.

    Raises:
        PolicyError: its data contradict each other.
    """

    who: str
    """Its name in messages."""
    skills: tuple[str, ...]
    """The names of the skills that it chooses from."""
    goals: dict[str, Space]
    """The goals of the skills that have some, by name."""

    advice = "write ({0!r}, goal) in place of {0!r}"
    """Advice on giving a goal to a skill, for messages."""

    def __post_init__(self) -> None:
        if not self.skills or len(set(self.skills)) < len(self.skills):
            raise PolicyError(f"{self.who} needs skills of different names, not {self.skills}")
        self._skill_numbers = {name: i for i, name in enumerate(self.skills)}
        for name in self.goals:
            self.number(name, ": its field goals", PolicyError)
        self._choices = self._numbers = discrete(self.count)
        if self.goals:
            parts = {SKILL: self._numbers, GOAL: Space("Dict", parts=self.goals)}
            self._choices = Space("Dict", parts=parts)
        self._fixed: dict[tuple[int, str], Any] = {}
        """By the place of a rule and a skill, see ``_goal``."""

    @property
    def count(self) -> int:  # type: ignore[override]
        """The number of its choices."""
        return len(self.skills)

    def number(self, skill: Any, where: str = "", kind: type[SkillweaveError] = SkillError) -> int:
        """Return the place of a skill in the list.

        Raises:
            SkillError: no skill has this name. ``kind`` is the type of the error.
        """
        found = self._skill_numbers.get(skill) if isinstance(skill, str) else None
        if found is None:
            raise kind(
                f"{self.who}{where} names {skill!r:.100}, which is no skill of the hierarchy; its "
                f"skills are: {', '.join(self.skills)[:1000]}"
            )
        return found

    def check_skills(self, names: Sequence[str], choice: Space | None, where: str) -> None:
        """Check that it has the hierarchy's skills, in their order, and makes its choices."""
        if list(self.skills) != list(names):
            raise PolicyError(
                f"{where}.skills are {shown(list(self.skills), 200)}, but the hierarchy has "
                f"{shown(list(names), 200)}"
            )
        if choice is not None and not self._choices.is_like(choice):
            raise PolicyError(f"{where} makes choices of {self._choices}, not of {choice}")

    def _chances(self, memory: Memory, rows: Array, obs: Array, may: Array) -> Array:
        choice = self.act(memory, rows, obs, Turn(World(), may))
        number = choice[SKILL] if self.goals else choice
        found: Array = np.eye(self.count, dtype=np.float32)[number]
        return found

    # Goals

    def _space(self, name: str, kind: type[SkillweaveError]) -> Space:
        """Return the space of a skill's goals; raise where a rule gave one for a skill without."""
        if name not in self.goals:
            raise kind(
                f"{self.who} gave a goal for skill {name!r}, which has no goals: set its "
                "goal_space, or leave out the goal"
            )
        return self.goals[name]

    def _goal(self, name: str, goal: Any) -> Any:
        """Return the goal of a skill as an array (*goal_shape), or the function that returns it.

        Raises:
            PolicyError: it does not fit the skill.
        """
        space = self._space(name, PolicyError)
        return goal if callable(goal) else space.packed(goal, f"{self.who}: the goal of {name!r}")

    def _given(self, name: str, goals: Any, n: int, rows: Array | None = None) -> Array:
        """Return the goals of a skill that a function gave; see ``Space.goals``."""
        space = self._space(name, SkillError)
        return space.goals(goals, n, self.who, f"skill {name!r}", rows=rows)

    def _with_fixed(self, skill: Array, place: Array, obs: Array) -> Array:
        """Return choices of skills (k,) with fixed goals; ``place`` (k,) is where the rule is."""
        found = []
        for (here, name), goal in self._fixed.items():
            rows = np.flatnonzero((place == here) & (skill == self.number(name)))
            if len(rows) and callable(goal):
                goal = self._given(name, goal(read_only(obs[rows])), len(rows))
            found.append((name, rows, goal))
        return self._with_goals(skill, found, obs)

    def _with_goals(
        self, choice: Array, goals: Iterable[tuple[str, Array, Any]], obs: Array
    ) -> Array:
        """Return choices (k,) with their goals, as a ``CallAndReturn`` takes them.

        Args:
            goals: skills, the rows (m,) in which each is chosen, and their goals.
            obs: (k, …), for messages.

        Raises:
            SkillError: a skill with goals was chosen without one.
        """
        if not self.goals:
            return choice
        choices = self._choices.start(len(choice))
        choices[SKILL] = choice
        skill = choice // (self.count // len(self.skills))
        lacks = np.isin(skill, [self.number(name) for name in self.goals])
        for name, rows, values in goals:
            if len(rows):
                choices[GOAL][name][rows] = values
                lacks[rows] = False
        if lacks.any():
            row = int(lacks.argmax())
            name = self.skills[skill[row]]
            raise SkillError(
                f"{self.who} chose skill {name!r} without a goal in observation "
                f"{observed(obs[row])}, but it has goals of {self.goals[name]}: "
                f"{self.advice.format(name)}"
            )
        return choices


def function_name(function: Any) -> str:
    """Return a user function's name for messages and checksums."""
    return str(getattr(function, "__name__", type(function).__name__))


# A function -------------------------------------------------------------------------------------


@dataclass(eq=False)
class FunctionRule(Rule):
    """A selector that acts by a function of observations (n, *obs_shape) to skills (n,).

    Where skills have goals, it returns skills and goals: ``(names, goals)``, the goals
    (n, *goal_shape), or a dict of such goals by skill where several have some. They count where the
    skill is chosen.
    """

    function: Callable[..., Any] = code("observations (n, ...) to skills (n,)", "selector")
    takes_last_call: bool = False
    """Its second argument is the ``LastCall``."""
    advice = "return (names, goals)"

    @property
    def ends_matter(self) -> bool:  # type: ignore[override]
        """It takes the last call."""
        return self.takes_last_call

    def start(self, n: int) -> Memory:
        """Return the initial last call, for functions that use it; else an empty memory."""
        if not self.takes_last_call:
            return {}
        why = np.full(n, EPISODE, np.int8)
        return {"skill": np.full(n, -1), "why": why, "succeeded": np.zeros(n, bool)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the function's choices, (k,)."""
        last = {name: read_only(values) for name, values in take(memory, rows).items()}
        more = [LastCall(**last)] if self.takes_last_call else []
        skill, found = self.parted(self.function(read_only(obs), *more), len(obs))
        if turn.mask is not None:
            wrong = ~turn.mask[np.arange(len(obs)), skill]
            if wrong.any():
                row = int(wrong.argmax())
                may = ", ".join(np.array(self.skills)[turn.mask[row]])
                raise SkillError(
                    f"{self.who} chose skill {self.skills[skill[row]]!r} in observation "
                    f"{observed(obs[row])}, but its initiation() is False there; choose a skill "
                    f"that may start there: {may}"
                )
        return self._with_goals(skill, found, obs)

    def parted(self, value: Any, n: int) -> tuple[Array, list[tuple[str, Array, Array]]]:
        """Return the numbers of skills (n,) in a value of the function, and its goals.

        Each entry of the goals is a skill, the rows (m,) in which it is chosen, and their goals.

        Raises:
            SkillError: it has another form, names unknown skills, or its goals do not fit.
        """
        chosen = value
        goals = None
        wrong = _is_other_form(value)
        if not wrong and isinstance(value, tuple) and len(value) == 2:
            arrays = isinstance(value[1], Mapping | list | tuple) or np.ndim(value[1])
            chosen, goals = value if arrays else (value, None)
        if (wrong or goals is not None) and not self.goals:
            raise SkillError(
                f"{self.who} returned skills and goals, but no skill that it selects has goals: "
                "set goal_space in the skill's class, or return the skills alone"
            )
        try:
            skill = np.asarray(None if wrong else chosen)
        except Exception as error:  # of parts of unequal lengths
            if not self.goals:
                text = f"{self.who} returned {value!r:.100}, which is no array: {error}"
                raise SkillError(text) from error
            wrong = True
        if wrong:
            raise SkillError(
                f"{self.who} returned {value!r:.100}: return (names, goals), one of each per "
                "environment"
            )
        if skill.dtype.kind in "UO" and skill.shape == (n,):
            skill = np.array([self.number(name) for name in skill.tolist()], int)
        skill = self._numbers.actions(skill, n, self.who, SkillError)
        found = []
        for name, values in ({} if goals is None else self._by_skill(goals)).items():
            mine = np.flatnonzero(skill == self.number(name))
            found.append((name, mine, self._given(name, values, n, mine)))
        return skill, found

    def _by_skill(self, goals: Any) -> dict[str, Any]:
        """Return the goals of several skills by their names."""
        only, *others = self.goals
        if isinstance(goals, Mapping):
            # Of a Dict a dict has the parts of goals where none of its keys is a skill.
            parts = not others and self.goals[only].kind == "Dict"
            return {only: goals} if parts and not set(goals) & set(self.skills) else dict(goals)
        if others:
            raise SkillError(
                f"{self.who} returned one array of goals, but {', '.join(self.goals)} have goals: "
                "return (names, {skill: goals})"
            )
        return {only: goals}

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Store the end of the last call."""
        for name, values in memory.items():
            values[rows] = getattr(last, name)


def _is_other_form(value: Any) -> bool:
    """Return whether a function that acts has paired skills and goals in another way."""
    if not isinstance(value, list | tuple):
        return False
    alone = isinstance(value, tuple) and len(value) == 2 and value[1] is None
    return alone or any(skill_and_goal(pair)[1] is not None for pair in (value, *value))


def skill_and_goal(value: Any) -> tuple[Any, Any]:
    """Return the name and the goal that a rule pairs; of anything else itself, and None."""
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], str):
        name, goal = value
        if goal is not None and not isinstance(goal, str):
            return name, goal
    return value, None


# An automaton -----------------------------------------------------------------------------------

ENDS = ("success", "failure")
"""Events of an automaton that are no functions: how a call ended."""


@dataclass(eq=False)
class StateMachine(Rule):
    """An automaton as it acts: states with skills, and transitions by events in steps.

    After every step the first transition of a state whose event has happened is taken. Where a call
    is over, the state's first skill that may start is called; a policy that samples draws among
    them.
    """

    states: dict[str, tuple[str, ...]]
    """The skills of each state, the best first, by the state's name."""
    first: str
    """The state in which episodes start."""
    transitions: tuple[tuple[str, str, str | Callable[..., Any]], ...] = code("a Step to (n,) bool")
    """From, to, and the event: "success", "failure", or a function of a ``Step``, (n,) bool."""
    state_goals: tuple[tuple[str, str, Array | Callable[..., Any]], ...] = field(
        default=(), metadata={"what": "observations (n, ...) to goals (n, *goal_shape)"}
    )
    """State, skill, and its goal there, or a function of observations that returns goals."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.ranks = np.zeros((len(self.states), len(self.skills)), np.int64)
        """(states, S): larger ones come first; 0: the skill is not in the state."""
        for i, (state, skills) in enumerate(self.states.items()):
            if not skills:
                raise PolicyError(f"{self.who}: state {state!r} has no skill")
            for place, skill in enumerate(skills):
                number = self.number(skill, f": state {state!r}", PolicyError)
                self.ranks[i, number] = len(skills) - place
        self._state_numbers = {name: i for i, name in enumerate(self.states)}
        self._first = self._state(self.first, "start")
        self._arrows = []
        for *pair, event in self.transitions:
            where = f"transition {shown(tuple(pair), 100)}"
            if event not in ENDS and not callable(event):
                raise PolicyError(
                    f"{self.who}: {where} has the event {shown(event, 100)}; give a function of a "
                    "Step, 'success' or 'failure'"
                )
            origin, target = (self._state(name, where) for name in pair)
            self._arrows.append((origin, target, event))
        self._fixed = {
            (self._state(state, "a goal"), skill): self._goal(skill, goal)
            for state, skill, goal in self.state_goals
        }

    def _state(self, name: str, where: str) -> int:
        """Return the number of a state; ``where`` it is named, for messages."""
        if name not in self._state_numbers:
            raise PolicyError(
                f"{self.who}: {where} names the state {shown(name, 100)}, which does not exist; "
                f"the states are: {', '.join(self.states)[:300]}"
            )
        return self._state_numbers[name]

    def start(self, n: int) -> Memory:
        """Return the memory of n environments in the first state."""
        return {"state": np.full(n, self._first)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return a skill of each environment's state, (k,)."""
        state = memory["state"][rows]
        may = self._may(state, obs, turn.mask)
        score = self.ranks[state]
        if not turn.greedy:
            score = (turn.world.rng or np.random.default_rng()).random(may.shape)
        skill = np.where(may, score, -1).argmax(axis=1)
        return self._with_fixed(skill, state, obs)

    def _chances(self, memory: Memory, rows: Array, obs: Array, may: Array) -> Array:
        may = self._may(memory["state"][rows], obs, may)
        share: Array = may / may.sum(axis=1, keepdims=True, dtype=np.float32)
        return share

    def _may(self, state: Array, obs: Array, mask: Array | None) -> Array:
        """Return the skills of states (k,) that may start, (k, S) bool, at least one per row."""
        may = self.ranks[state] > 0
        if mask is not None:
            may &= mask
        if not may.any(axis=1).all():
            row = int((~may.any(axis=1)).argmax())
            name = tuple(self.states)[state[row]]
            raise SkillError(
                f"{self.who}: in state {name!r} none of its skills "
                f"({', '.join(self.states[name])}) may start in observation {observed(obs[row])}: "
                "initiation() is False there. Add a skill to the state, or let one start there"
            )
        return may

    def allowed(self, memory: Memory, rows: Array) -> Array:
        """Return the skills of the states, see ``Selector``."""
        allowed: Array = self.ranks[memory["state"][rows]] > 0
        return allowed

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Take the transitions whose events have happened in a step."""
        before = memory["state"][rows]
        after = before.copy()
        waits = np.ones(len(rows), bool)
        for origin, target, event in self._arrows:
            taken = waits & (before == origin)
            if not taken.any():
                continue
            if isinstance(event, str):
                taken &= (last.why != RUNNING) & (last.succeeded == (event == "success"))
            else:
                taken &= call_plainly(event, step, rows, self.who, function_name(event))
            after[taken] = target
            waits &= ~taken
        memory["state"][rows] = after


# A behaviour tree -------------------------------------------------------------------------------


class Status(IntEnum):
    """The status of a node of a tree."""

    RUNNING = 0
    SUCCESS = 1
    FAILURE = 2


@dataclass(frozen=True, eq=False)
class Leaf:
    """A skill in an acting behaviour tree."""

    skill: str
    goal: Array | Callable[..., Any] | None = code(
        "observations (n, ...) to goals (n, *goal_shape)", needed=False
    )
    """Its goal, or a function of observations that returns goals; None: it has none."""


@dataclass(frozen=True, eq=False)
class TreeCondition:
    """A condition in an acting tree: SUCCESS where it holds, else FAILURE."""

    name: str
    """The function's name in messages."""
    function: Callable[..., Any] = code("observations (n, ...) to (n,) bool")


@dataclass(frozen=True, eq=False)
class Branch:
    """A node of an acting tree with children, which are evaluated in order."""

    kind: Literal["Sequence", "Fallback"]
    """A Sequence continues while they succeed, a Fallback while they fail."""
    children: tuple[Leaf | TreeCondition | Branch, ...]
    memory: bool = True
    """Continue with the running child; else begin with the first one at each evaluation."""


Node = Leaf | TreeCondition | Branch
GOES_ON = {"Sequence": Status.SUCCESS, "Fallback": Status.FAILURE}
"""By kind of a branch, the status of a child after which the next one is evaluated."""


@dataclass(eq=False)
class Tree(Rule):
    """A behaviour tree as it acts, for all environments at once, where calls are over.

    It remembers ``leaf`` (that of the last call, −1: none), ``succeeded`` (that call succeeded),
    and ``child`` (n, C) (the running child of each branch).
    """

    root: Leaf | TreeCondition | Branch

    def __post_init__(self) -> None:
        super().__post_init__()
        self.places: dict[Node, int] = {}
        """The number of each node among those of its kind."""
        self._alike: dict[type, list[Any]] = {Leaf: [], TreeCondition: [], Branch: []}
        self._place(self.root)
        leaves, self.checks = self._alike[Leaf], self._alike[TreeCondition]
        if not leaves:
            raise PolicyError(f"{self.who} has no skill")
        self.skill_of = np.array([self.number(x.skill, ": a leaf", PolicyError) for x in leaves])
        """(leaves,), the skill of each leaf."""
        self._fixed = {
            (i, leaf.skill): self._goal(leaf.skill, leaf.goal)
            for i, leaf in enumerate(leaves)
            if leaf.goal is not None
        }

    def _place(self, node: Node) -> None:
        """Give a node and all below it numbers, so that memories can be arrays."""
        alike = self._alike[type(node)]
        if node in self.places:
            raise PolicyError(f"{self.who}: a node stands in two places: {node!r:.100}")
        self.places[node] = len(alike)
        alike.append(node)
        if isinstance(node, Branch):
            if not node.children or node.kind not in GOES_ON:
                raise PolicyError(
                    f"{self.who}: a node is a {node.kind} of {len(node.children)} children; it "
                    "must be a Sequence or a Fallback of at least one"
                )
            for child in node.children:
                self._place(child)

    def start(self, n: int) -> Memory:
        """Return a memory without a running call."""
        return {
            "leaf": np.full(n, -1),
            "succeeded": np.zeros(n, bool),
            "child": np.zeros((n, len(self._alike[Branch])), np.int64),
        }

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the skill of the leaf that each environment's tree runs, (k,)."""
        mask = np.ones((len(obs), len(self.skills)), bool) if turn.mask is None else turn.mask
        tick = _Tick(self, take(memory, rows), obs, mask)
        status = tick.run(self.root, np.arange(len(obs)))
        again = np.flatnonzero(status != Status.RUNNING)
        if len(again):  # the whole tree is over: it starts again
            tick.restart(again)
            status[again] = tick.run(self.root, again)
        if (status != Status.RUNNING).any():
            row = int((status != Status.RUNNING).argmax())
            raise SkillError(
                f"{self.who} ended ({Status(status[row]).name}) in observation "
                f"{observed(obs[row])} without a skill that may start there: add a Fallback whose "
                "last child is a skill that may start everywhere"
            )
        put(memory, rows, {"leaf": tick.leaf, "child": tick.after})
        return self._with_fixed(self.skill_of[tick.leaf], tick.leaf, obs)

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Store whether the running call has succeeded.

        If a policy that the tree only guides called another skill than the leaf's, the leaf did not
        run: it is evaluated again.
        """
        over = last.why != RUNNING
        called = self.skill_of[memory["leaf"][rows]] == last.skill
        memory["leaf"][rows[over & ~called]] = -1
        memory["succeeded"][rows[over]] = last.succeeded[over]


class _Tick:
    """One evaluation of a tree for n environments, at a decision."""

    def __init__(self, tree: Tree, memory: Memory, obs: Array, mask: Array) -> None:
        self._tree = tree
        self._obs = obs
        self._mask = mask
        self._before = memory["child"]
        self._succeeded = memory["succeeded"]
        self.leaf = memory["leaf"]
        # Zeros: nodes that this evaluation does not reach are no longer running.
        self.after = np.zeros_like(self._before)

    def restart(self, rows: Array) -> None:
        """Restart environments ``rows`` at the root, without a running call."""
        self.leaf[rows] = -1
        self._before[rows] = self.after[rows] = 0

    def run(self, node: Node, rows: Array) -> Array:
        """Return the status of a node in environments ``rows`` (m,), (m,)."""
        place = self._tree.places[node]
        if isinstance(node, Leaf):
            return self._leaf(place, rows)
        if isinstance(node, Branch):
            return self._branch(node, place, rows)
        seen = read_only(self._obs[rows])
        holds = call_plainly(node.function, seen, rows, self._tree.who, node.name)
        return np.where(holds, Status.SUCCESS, Status.FAILURE)

    def _leaf(self, place: int, rows: Array) -> Array:
        """Return the end of a leaf's call, if that was the last one; else start its call."""
        status = np.where(self._succeeded[rows], Status.SUCCESS, Status.FAILURE)
        fresh = self.leaf[rows] != place
        starts = self._mask[rows, self._tree.skill_of[place]]
        status[fresh] = np.where(starts[fresh], Status.RUNNING, Status.FAILURE)
        self.leaf[rows[fresh & starts]] = place
        return status

    def _branch(self, node: Branch, place: int, rows: Array) -> Array:
        """Evaluate the children in turn, until one of them decides."""
        goes_on = GOES_ON[node.kind]
        status = np.full(len(rows), goes_on)
        first = self._before[rows, place] * node.memory
        for i, child in enumerate(node.children):
            reached = np.flatnonzero((status == goes_on) & (first <= i))
            if len(reached):
                status[reached] = self.run(child, rows[reached])
                running = reached[status[reached] == Status.RUNNING]
                self.after[rows[running], place] = i
        return status
