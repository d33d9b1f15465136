"""An automaton as a selector: states with skills, and transitions by events in steps.

Its states and events are those of a reward machine (Toro Icarte, Klassen, Valenzano & McIlraith
2018, "Using Reward Machines for High-Level Task Specification"), without the rewards.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, SkillError
from skillweave.messages import short
from skillweave.policies.core import CallEnd, LastCall, observed
from skillweave.selectors.base import (
    ReadySelector,
    function_name,
    goal_as_json,
    goals_at,
    listed,
    skill_and_goal,
)
from skillweave.skills.answers import answer
from skillweave.skills.foreign_policy import checksum
from skillweave.types import Array, Memory, Step

Event = Callable[[Step], Any] | str
"""The event of a transition: a function of a ``Step``, (n,) bool, or "success" or "failure"."""
Choices = str | tuple[str, Any] | Sequence[Any] | set[Any] | frozenset[Any]
"""The skills of a state."""
ENDS = ("success", "failure")


@checked_names
class Automaton(ReadySelector):
    """An automaton: states, each with the skills that are called in it, and transitions.

    ```python
    import skillweave as sw


    def has_key(step):
        return step.next_obs[:, 1] == 1


    selector = sw.Automaton(
        states={"no key": "get_key", "key": {"open_door", "push_door"}, "open": "leave"},
        transitions={("no key", "key"): has_key, ("key", "open"): "success"},
    )
    ```

    After every step, also within a call, the transitions of each environment's state are checked
    in the order of declaration; the first whose event has happened is taken, and no other in this
    step. The event "success" means that the call ended in this step and succeeded, "failure" that
    it ended without success. A transition does not end a call: the skills of the new state are
    called when the running call is over. Every episode starts in ``start``.

    A skill that has goals stands in a state with its goal, ``("go_to", (0.5, 1.0))``: an element of
    its ``goal_space``, or a function of observations (n, *obs_shape) that returns goals
    (n, *goal_shape).

    Among several skills that may start, greedy selection calls the first (in the order of a list;
    in the hierarchy's order of a set), else one uniformly at random.

    Args:
        states: a skill's name, or several, by the state's name; ``(name, goal)`` where a skill has
            goals.
        transitions: the event by (from, to).
        start: the first state; None: the first in ``states``.

    Raises:
        DeclarationError: a state has no skill, or a transition names an unknown state.
        SkillError: when it acts: no skill of the state may start.
    """

    kind = "automaton"

    def __init__(
        self,
        states: Mapping[str, Choices],
        transitions: Mapping[tuple[str, str], Event],
        start: str | None = None,
    ) -> None:
        super().__init__("automaton")
        if not isinstance(states, Mapping) or not states:
            raise DeclarationError(
                f"an Automaton's states are {short(states)}; give at least one, with its skills: "
                "states={'search': 'explore'}"
            )
        self.goals: dict[tuple[str, str], Any] = {}
        """The goals by state and skill, where skills have some."""
        self.states = {
            _name(name): _skills(name, skills, self.goals) for name, skills in states.items()
        }
        self.state_names = tuple(self.states)
        self.start_state = self.state_names[0] if start is None else start
        self._number_of_state(self.start_state, "start")
        if not isinstance(transitions, Mapping):
            raise DeclarationError(
                f"an Automaton's transitions are {short(transitions)}; write "
                "transitions={('from', 'to'): event}"
            )
        self.transitions = dict(transitions)
        self.arrows = [(*self._ends_of(pair, e), e) for pair, e in self.transitions.items()]
        self.ranks = np.zeros((len(states), 0))

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the ``skills`` of these names."""
        selector = super().among(skills)
        # Larger ranks come first; 0: the skill is not in the state.
        selector.ranks = np.zeros((len(self.states), len(skills)), np.int64)
        for i, (state, names) in enumerate(self.states.items()):
            numbers = [selector._number(n, f"automaton: state {short(state)}") for n in names]
            numbers = sorted(numbers) if isinstance(names, frozenset) else numbers
            for place, number in enumerate(numbers):
                selector.ranks[i, number] = len(numbers) - place
        return selector

    @property
    def ranges(self) -> dict[str, range]:
        """Return the range of state numbers."""
        return {"state": range(len(self.state_names))}

    @property
    def gives_goals(self) -> bool:
        """Return whether a state gives its skill a goal."""
        return bool(self.goals)

    def start(self, n: int) -> Memory:
        """Return the memory of ``n`` environments in the first state."""
        return {"state": np.full(n, self.state_names.index(self.start_state))}

    def allowed(self, memory: Memory) -> Array:
        """Return the skills of each environment's state in ``memory``, (n, S) bool."""
        allowed: Array = self.ranks[memory["state"]] > 0
        return allowed

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return a skill of each environment's state, (n,)."""
        allowed = self._startable(memory, obs, mask)
        score = self.ranks[memory["state"]]
        if not deterministic:
            score = (rng or np.random.default_rng()).random(allowed.shape)
        skill = np.where(allowed, score, -1).argmax(axis=1)
        if not self.goals and not self.goal_spaces:
            return skill, memory
        return self.with_goals(skill, self._goals_of(memory, skill, obs), obs), memory

    def _goals_of(self, memory: Memory, skill: Array, obs: Array) -> dict[str, tuple[Array, Any]]:
        """Return the goals of the chosen skills, with their rows, by skill."""
        found: dict[str, list[tuple[Array, Any]]] = {}
        for (state, name), goal in self.goals.items():
            here = memory["state"] == self.state_names.index(state)
            rows = np.flatnonzero(here & (skill == self.skills.index(name)))
            if len(rows):
                who = f"{self._who}: state {short(state)}: the goal of {name!r}"
                values = goals_at(goal, self.goal_spaces.get(name), obs[rows], who)
                found.setdefault(name, []).append((rows, values))
        return {name: self._joined_goals(name, parts) for name, parts in found.items()}

    def chances(self, memory: Memory, obs: Array, mask: Array | None) -> tuple[Array, Memory]:
        """Return equal probabilities of all skills of the state that may start, (n, S).

        ``mask`` is (n, S) bool, ``memory`` of n environments; ``obs`` is only for messages.
        """
        allowed = self._startable(memory, obs, mask)
        share: Array = allowed / allowed.sum(axis=1, keepdims=True, dtype=np.float32)
        return share, memory

    def watch(self, memory: Memory, step: Step, last: LastCall) -> Memory:
        """Take the transitions whose events happened in a ``step``; return the new ``memory``.

        ``last`` has the ends of the last calls.
        """
        before, after = memory["state"], memory["state"].copy()
        waiting = np.ones(len(before), bool)  # no transition was taken yet
        for origin, target, event in self.arrows:
            taken = waiting & (before == origin)
            if not taken.any():
                continue
            taken &= self._happened(event, step, last)
            after[taken] = target
            waiting &= ~taken
        return {"state": after}

    def source(self) -> dict[str, Any]:
        """Return the checksum of its states and transitions, with only the names of functions."""
        arrows = [
            [*pair, event if isinstance(event, str) else [function_name(event)]]
            for pair, event in self.transitions.items()
        ]
        states = [
            [name, sorted(skills) if isinstance(skills, frozenset) else ["in order", *skills]]
            for name, skills in self.states.items()
        ]
        goals = [[*pair, goal_as_json(goal)] for pair, goal in self.goals.items()]
        whole = json.dumps([self.start_state, states, arrows, *([goals] if goals else [])])
        return {"kind": self.kind, "name": self.name, "sha256": checksum(whole.encode())}

    def _startable(self, memory: Memory, obs: Array, mask: Array | None) -> Array:
        """Return the skills of the state that may start, (n, S) bool, at least one per row."""
        allowed = self.allowed(memory)
        if mask is not None:
            allowed = allowed & mask
        if not allowed.any(axis=1).all():
            self._nothing_may_start(memory, obs, int(np.flatnonzero(~allowed.any(axis=1))[0]))
        return allowed

    def _happened(self, event: Event, step: Step, last: LastCall) -> Array:
        """Return whether an event has happened in this step, (n,) bool."""
        if isinstance(event, str):
            as_named = last.succeeded if event == "success" else ~last.succeeded
            happened: Array = (last.why != CallEnd.RUNNING) & as_named
            return happened
        name = function_name(event)
        n = len(step.reward)
        return answer(event, step, n, bool, self._who, name, step.elapsed)

    def _ends_of(self, pair: Any, event: Any) -> tuple[int, int]:
        """Check a transition and its event; return the numbers of its two states."""
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise DeclarationError(
                f"an Automaton's transition is from {short(pair)}; write ('from', 'to'): event"
            )
        where = f"transition {short(pair)}"
        origin, target = (self._number_of_state(name, where) for name in pair)
        if event not in ENDS and not callable(event):
            raise DeclarationError(
                f"automaton: {where} has the event {short(event)}; give a function of a Step, "
                "'success' or 'failure'"
            )
        return origin, target

    def _number_of_state(self, name: Any, where: str) -> int:
        if name not in self.state_names:
            raise DeclarationError(
                f"automaton: {where} names the state {short(name)}, which does not exist; the "
                f"states are: {listed(self.state_names)}"
            )
        return self.state_names.index(name)

    def _nothing_may_start(self, memory: Memory, obs: Array, row: int) -> None:
        state = self.state_names[int(memory["state"][row])]
        raise SkillError(
            f"{self._who}: in state {short(state)} none of its skills ("
            f"{listed(tuple(self.states[state]))}) may start in observation {observed(obs[row])}: "
            "initiation() is False there. Add a skill to the state, or let one start there"
        )


def _name(state: Any) -> str:
    if not isinstance(state, str) or not state:
        raise DeclarationError(f"an Automaton's state is named {short(state)}; it must be text")
    return state


def _skills(
    state: str, skills: Any, goals: dict[tuple[str, str], Any]
) -> tuple[str, ...] | frozenset[str]:
    """Return the names of a state's skills: in order, or as a set; set their ``goals``."""
    if skill_and_goal(skills)[1] is not None:
        skills = [skills]
    if isinstance(skills, list | tuple | set | frozenset):
        pairs = [skill_and_goal(skill) for skill in skills]
        goals |= {(state, name): goal for name, goal in pairs if goal is not None}
        skills = type(skills)(name for name, _ in pairs)
    if isinstance(skills, str):
        return (skills,)
    where = f"automaton: state {short(state)}"
    if not isinstance(skills, list | tuple | set | frozenset):
        raise DeclarationError(
            f"{where} has {short(skills)}; give a skill's name, or a list or a set of names"
        )
    if not skills:
        raise DeclarationError(f"{where} has no skill: give at least one, to be called in it")
    for name in skills:
        if not isinstance(name, str):
            raise DeclarationError(f"{where} has {short(name)} among its skills; give their names")
    return frozenset(skills) if isinstance(skills, set | frozenset) else tuple(skills)
