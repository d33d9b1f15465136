"""An automaton as a selector: states with skills, and transitions by events in steps.

Its states and events are those of a reward machine (Toro Icarte, Klassen, Valenzano & McIlraith
2018, "Using Reward Machines for High-Level Task Specification"), without the rewards.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave.errors import DeclarationError
from skillweave.policies import selectors
from skillweave.policies.acting_errors import PolicyError
from skillweave.policies.core import Step
from skillweave.policies.selectors import function_name, skill_and_goal
from skillweave.policies.untrusted import checksum
from skillweave.schema import Check, fitted
from skillweave.skills.selector import ReadySelector, checked_function, goal_as_json

Event = Callable[[Step], Any] | str
"""The event of a transition: a function of a ``Step``, (n,) bool, or "success" or "failure"."""
Choices = str | tuple[str, Any] | Sequence[Any] | set[Any] | frozenset[Any]
"""The skills of a state."""
StateName = Annotated[str, Check("a text", bool)]
"""The name of a state."""


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
            fitted(StateName, name, "an Automaton's state"): _skills(name, skills, self.goals)
            for name, skills in states.items()
        }
        self.state_names = tuple(self.states)
        self.start_state = self.state_names[0] if start is None else start
        check_transitions(transitions, "an Automaton's")
        self.transitions = dict(transitions)
        skills = tuple(dict.fromkeys(name for _, name, _ in self.named()))
        ordered = {state: tuple(names) for state, names in self.states.items()}
        arrows = tuple((*pair, event) for pair, event in self.transitions.items())
        try:
            selectors.StateMachine("automaton", skills, {}, ordered, self.start_state, arrows)
        except PolicyError as error:
            raise DeclarationError(str(error)) from None

    def named(self) -> Iterator[tuple[str, str, Any]]:
        """Yield the skills of all states, with their goals there."""
        for state, names in self.states.items():
            for name in names:
                yield f"state {short(state)}", name, self.goals.get((state, name))

    @cached_property
    def in_place(self) -> selectors.StateMachine:  # type: ignore[override]
        """The acting rule of the automaton."""
        ordered = (
            names if isinstance(names, tuple) else tuple(filter(names.__contains__, self.skills))
            for names in self.states.values()
        )
        states = dict(zip(self.states, ordered, strict=True))
        transitions = tuple(
            (
                *pair,
                event
                if isinstance(event, str)
                else checked_function(event, self._who, function_name(event)),
            )
            for pair, event in self.transitions.items()
        )
        goals = tuple(
            (state, name, self._goal(name, goal, f"{self._who}: state {short(state)}"))
            for (state, name), goal in self.goals.items()
        )
        return selectors.StateMachine(*self._rule_of, states, self.start_state, transitions, goals)

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


def check_transitions(transitions: Any, whose: str) -> None:
    """Raise a DeclarationError where transitions are no dict by (from, to)."""
    if not isinstance(transitions, Mapping):
        raise DeclarationError(
            f"{whose} transitions are {short(transitions)}; write "
            "transitions={('from', 'to'): event}"
        )
    for pair in transitions:
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise DeclarationError(
                f"{whose} transition is from {short(pair)}; write ('from', 'to'): event"
            )


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
