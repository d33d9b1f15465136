"""Reward machines: tasks as states, with transitions by events, and rewards.

Toro Icarte, Klassen, Valenzano & McIlraith 2018, "Using Reward Machines for High-Level Task
Specification". An event that must hold for n steps has a counter, so n states are not written out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short, suggest
from skillweave._internal.rewards import LARGEST_REWARD
from skillweave.calls.predicates import Event, Held, Predicate, as_event, predicate_of
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array, Step
from skillweave.policies.plan import Machine
from skillweave.policies.selectors import function_name
from skillweave.schema import fitted
from skillweave.skills.automaton import Automaton, StateName, check_transitions
from skillweave.skills.outputs import Wrapped
from skillweave.skills.selector import checked_function, listed

MOST_STATES = 10_000
"""The most states of a machine."""
MOST_AUTOMATON = 2_000
"""The most states of the automaton that is made of a machine, whose counters become states."""
MOST_CELLS = 20_000_000
"""The most places for predicates in a machine's arrays."""
_NEVER = np.iinfo(np.int64).max

Reward = float | Callable[[Step], Any]
"""A number, or a function of a ``Step`` that returns (n,) numbers."""


@dataclass(frozen=True)
class Arrow:
    """A transition: it is taken where all its events hold."""

    origin: int
    target: int
    events: tuple[Event, ...]
    reward: Reward = 0.0
    keeps: frozenset[int] = frozenset()
    """Slots of counters that go on counting after the transition."""


@checked_names
class RewardMachine:
    """A task: states, transitions by events, and rewards.

    ```python
    from skillweave.planning import RewardMachine, held


    def at_left(obs):
        return obs[:, 0] < -0.5


    def high(obs):
        return obs[:, 1] > 0.8


    task = RewardMachine(
        {
            ("to left", "to top"): (at_left, 0.5),
            ("to top", "done"): (held(high, 20), 0.5),
        },
        accepting={"done"},
    )
    ```

    After every step the transitions of the current state are checked in the order of declaration;
    the first whose event holds is taken, and no other in this step. Accepting and failing states
    end the task. Where nothing pays, an accepting state pays 1. A counter of ``held`` starts at 0
    where its state is entered.

    Args:
        transitions: by (from, to), the event: a predicate, a function of observations or of a
            ``Step``, or ``held(...)``; or (event, reward), the reward a number or a function of a
            ``Step``; or a list of these.
        start: the first state; None: the first that is named.
        accepting: states in which the task has succeeded.
        failing: states in which it has failed.
        each_step: the reward of every step outside accepting and failing states: a number, a
            function of a ``Step``, or such by state.

    Raises:
        DeclarationError: a state is unknown, an accepting or failing state has transitions, or a
            value has a wrong type.
    """

    def __init__(
        self,
        transitions: Mapping[tuple[str, str], Any],
        *,
        start: str | None = None,
        accepting: Collection[str] = (),
        failing: Collection[str] = (),
        each_step: Any = 0.0,
    ) -> None:
        check_transitions(transitions, "a RewardMachine's")
        named: dict[str, int] = {}
        for pair in transitions:
            for state in pair:
                named.setdefault(fitted(StateName, state, "a RewardMachine's state"), len(named))
        if not named:
            named[start if isinstance(start, str) and start else "always"] = 0
        done, failed = (
            frozenset(_number(name, named, what) for name in _states(states, what))
            for states, what in ((accepting, "accepting"), (failing, "failing"))
        )
        if both := done & failed:
            raise DeclarationError(
                f"RewardMachine: the state {[*named][min(both)]!r} is both accepting and failing; "
                "choose one"
            )
        first = 0 if start is None else _number(start, named, "start")
        over = done | failed
        arrows = list[Arrow]()
        slots = dict[int, int]()
        for pair, value in transitions.items():
            origin, target = named[pair[0]], named[pair[1]]
            if origin in over:
                raise DeclarationError(
                    f"RewardMachine: the state {pair[0]!r} ends the task, so it has no transition; "
                    f"leave out {pair}"
                )
            where = f"RewardMachine: transition {pair}"
            for one in value if isinstance(value, list) else [value]:
                given = one if isinstance(one, tuple) else (one, 0.0)
                if len(given) != 2:
                    raise DeclarationError(
                        f"{where} is {short(one)}; write an event, or (event, reward)"
                    )
                event, reward = as_event(given[0], where), _checked_reward(given[1], where)
                if isinstance(event, Held):
                    event = replace(event, slot=slots.get(origin, 0))
                    slots[origin] = event.slot + 1
                arrows.append(Arrow(origin, target, (event,), reward))
        each = {q: r for q, r in _each_step(each_step, named).items() if q not in over}
        if not any(callable(r) or r for r in (*each.values(), *(arrow.reward for arrow in arrows))):
            arrows = [replace(arrow, reward=float(arrow.target in done)) for arrow in arrows]
        self._build(tuple(named), arrows, done, failed, first, each)

    def _build(
        self,
        names: tuple[str, ...],
        arrows: Sequence[Arrow],
        accepting: Collection[int],
        failing: Collection[int],
        first: int = 0,
        each_step: Mapping[int, Reward] | None = None,
    ) -> None:
        """Turn the parts of a machine into arrays, one row for each state.

        Args:
            names: of the states.
            arrows: in the order in which they are checked.
            accepting: states.
            failing: states.
            first: the state at the start.
            each_step: the reward of every step in a state.
        """
        if len(names) > MOST_STATES:
            raise DeclarationError(
                f"the task has {len(names):,} states; at most {MOST_STATES:,} are possible: "
                "repeat it less often, or combine fewer sequences by 'and' or 'or'"
            )
        self.state_names = names
        self.arrows = arrows
        self.leaving: list[list[Arrow]] = [[] for _ in names]
        """The transitions from each state, in the order in which they are checked."""
        for arrow in arrows:
            self.leaving[arrow.origin].append(arrow)
        self.slots = max((h.slot + 1 for arrow in arrows for h in _held(arrow)), default=0)
        """Counters side by side."""
        self.events: list[Predicate] = []
        self.rewards: list[Callable[[Step], Any]] = []
        count = len(names)
        most = max(1, *map(len, self.leaving))
        atoms = max([1, *(len(arrow.events) for arrow in arrows)])
        if count * most * atoms > MOST_CELLS:
            raise DeclarationError(
                f"the task has {count:,} states, of which one has {most:,} transitions; combine "
                "fewer parts by 'and' or 'or', or repeat less often"
            )
        for arrow in arrows:
            for predicate in predicates_of(arrow):
                self.number(predicate)
        # Two columns behind those of the events: one is never true, the other always.
        never = len(self.events)
        always = len(self.events) + 1
        counted = np.full((count, self.slots), never)
        self.counter_steps = np.full((count, self.slots), _NEVER)
        """Steps for which each counter must count, (Q, H); the largest number: it is not used."""
        each_atom = np.full((count, most, atoms), always)
        each_atom[:, :, 0] = never
        target = np.arange(count)[:, None].repeat(most, 1)
        paid = np.zeros((count, most))
        paid_by = np.zeros((count, most), np.int64)
        keeps = np.zeros((count, most, self.slots), bool)
        for q, some in enumerate(self.leaving):
            for t, arrow in enumerate(some):
                for a, event in enumerate(arrow.events):
                    each_atom[q, t, a] = number = self.number(predicate_of(event))
                    if isinstance(event, Held):
                        counted[q, event.slot] = number
                        self.counter_steps[q, event.slot] = event.steps
                        each_atom[q, t, a] = always + 1 + event.slot
                target[q, t] = arrow.target
                paid[q, t], paid_by[q, t] = self._reward(arrow.reward)
                keeps[q, t, list(arrow.keeps)] = True
        each = np.zeros(count)
        each_by = np.zeros(count, np.int64)
        for q, reward in (each_step or {}).items():
            each[q], each_by[q] = self._reward(reward)
        events = [
            (Wrapped(e.function, e.at if e.reads == "obs" else e.holds), e.reads)
            for e in self.events
        ]
        rewards = [
            checked_function(reward, "task", function_name(reward), np.float64)
            for reward in self.rewards
        ]
        self.acts = Machine(
            first, counted, self.counter_steps, each_atom, target, paid, paid_by, keeps, each,
            each_by, tuple(events), tuple(rewards),
        )  # fmt: skip
        """The task as data, by which a plan follows it."""
        self.pays = bool(paid.any() or paid_by.any() or each.any() or each_by.any())
        """A transition or a step of it has a reward."""
        self.accepting = np.isin(np.arange(count), list(accepting))
        """The states in which the task has succeeded, (Q,) bool."""
        self.failing = np.isin(np.arange(count), list(failing))
        """The states in which it has failed, (Q,) bool."""

    def number(self, predicate: Predicate) -> int:
        """Return the number of a predicate among the events; the same function has one number."""
        for i, known in enumerate(self.events):
            if known.function == predicate.function and known.reads == predicate.reads:
                return i
        self.events.append(predicate)
        return len(self.events) - 1

    def _reward(self, reward: Reward) -> tuple[float, int]:
        """Return a reward as a number, and the column of its value; 0: none."""
        if not callable(reward):
            return float(reward), 0
        if reward not in self.rewards:
            self.rewards.append(reward)
        return 0.0, self.rewards.index(reward) + 1

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {listed(self.state_names)}>"

    def start(self, n: int) -> Array:
        """Return the state of ``n`` environments at the start of the task, (n, 1 + H) int64.

        Column 0 is the number of the machine's state, the others are its counters.
        """
        return self.acts.start(n)

    def step(self, state: Array, step: Step) -> tuple[Array, Array, Array]:
        """Return the state after a ``step``, the reward, and where the task is over.

        Args:
            state: (n, 1 + H), from ``start`` or the step before.
            step: of n environments.

        Returns:
            The next state (n, 1 + H), rewards (n,) float64, and (n,) bool: accepted or failed.

        Raises:
            SkillError: a predicate or a reward failed, or returned another shape or type.
        """
        after, reward = self.acts.advance(state, self.acts.read(step))
        return after, reward, self.is_over(after)

    def is_over(self, state: Array) -> Array:
        """Return where the task is over, (n, …) bool."""
        over: Array = (self.accepting | self.failing)[state[..., 0]]
        return over

    def has_succeeded(self, state: Array) -> Array:
        """Return where the task has succeeded, (n, …) bool."""
        succeeded: Array = self.accepting[state[..., 0]]
        return succeeded

    @property
    def observation_space(self) -> Box:
        """The space of ``observe``: one number for each state, and one for each counter."""
        return Box(0.0, 1.0, (len(self.state_names) + self.slots,), np.float32)

    def observe(self, state: Array) -> Array:
        """Return a task's state for a policy to see, (n, Q + H) float32.

        The machine's state is one-hot; a counter is its share of the steps that it must count.
        """
        q = state[:, 0]
        one_hot = q[:, None] == np.arange(len(self.state_names))
        share = state[:, 1:] / self.counter_steps[q].astype(np.float64)
        return np.concatenate([one_hot, share], 1, dtype=np.float32)

    def automaton(self, skills: Mapping[str, Any], after: Any = None) -> Automaton:
        """Return the task as a ready selector that calls a skill for each event.

        In each state it calls the skills of the events that lead on, but not to a failing state.
        Counters become states.

        Args:
            skills: by the name of a predicate, a skill's name or several.
            after: the skills that are called when the task is over; None: all of ``skills``.

        Raises:
            DeclarationError: an event has no skill, a state waits for two ``held`` events, or the
                automaton would have more than 2,000 states.
        """
        every = [name for some in skills.values() for name in _names(some)]
        after = list(dict.fromkeys(every)) if after is None else after
        states: dict[str, Any] = {}
        transitions: dict[tuple[str, str], Any] = {}
        for q, name in enumerate(self.state_names):
            chosen = [
                skill
                for arrow in self.leaving[q]
                if not self.failing[arrow.target]
                for skill in _skills_of(arrow, skills)
            ]
            counters = self._counters(q)
            if len(counters) > 1:
                raise DeclarationError(
                    f"in the state {name!r} the task waits for two events that must hold for "
                    "several steps, which no automaton can follow: plan the task instead"
                )
            steps = counters[0].steps if counters else 1
            if len(states) + steps > MOST_AUTOMATON:
                raise DeclarationError(
                    f"the automaton would have more than {MOST_AUTOMATON:,} states, as each step "
                    "of held() becomes one: plan the task instead"
                )
            over = self.accepting[q] or self.failing[q]
            calls = after if over or not chosen else list(dict.fromkeys(chosen))
            for i in range(steps):
                states[_counted_name(name, i)] = calls
                transitions |= self._automaton_arrows(q, counters, i)
        return Automaton(states, transitions, self.state_names[self.acts.first])

    def _automaton_arrows(
        self, state: int, counters: Sequence[Held], count: int
    ) -> dict[tuple[str, str], Callable[[Step], Any]]:
        """Return an automaton's transitions from a state, whose counter stands at ``count``."""
        name = self.state_names[state]
        ways: dict[str, list[list[Predicate]]] = {}
        for arrow in self.leaving[state]:
            if any(count + 1 < held.steps for held in _held(arrow)):
                continue
            target = self.state_names[arrow.target]
            holds = predicates_of(arrow)
            for counter in counters:
                goes_on = any(counter.slot == held.slot for held in self._counters(arrow.target))
                if counter.slot in arrow.keeps and goes_on and count + 1 < counter.steps:
                    counted = _counted_name(target, count + 1)
                    ways.setdefault(counted, []).append([*holds, counter.predicate])
            ways.setdefault(target, []).append(holds)
        for counter in counters:
            if count + 1 < counter.steps:
                ways.setdefault(_counted_name(name, count + 1), []).append([counter.predicate])
            if count:
                ways.setdefault(name, []).append([~counter.predicate])
        origin = _counted_name(name, count)
        return {(origin, target): _any_of(some) for target, some in ways.items()}

    def _counters(self, state: int) -> list[Held]:
        """Return the events of several steps that a state waits for, each counter once."""
        held = {h.slot: h for arrow in self.leaving[state] for h in _held(arrow)}
        return list(held.values())


def predicates_of(arrow: Arrow) -> list[Predicate]:
    """Return the predicates that an arrow's events read."""
    return [predicate_of(event) for event in arrow.events]


def _held(arrow: Arrow) -> list[Held]:
    """Return an arrow's events of several steps."""
    return [event for event in arrow.events if isinstance(event, Held)]


def _counted_name(name: str, count: int) -> str:
    return name if count == 0 else f"{name} ({count} steps held)"


def _any_of(ways: Sequence[Sequence[Predicate]]) -> Callable[[Step], Any]:
    """Return the event that all predicates of one of the ways hold."""

    def event(step: Step) -> Array:
        holds = [np.logical_and.reduce([p.holds(step) for p in some]) for some in ways]
        found: Array = np.logical_or.reduce(holds)
        return found

    event.__name__ = " or ".join(" and ".join(p.name for p in some) for some in ways)
    return event


def _names(skills: Any) -> list[str]:
    return [skills] if isinstance(skills, str) else list(skills)


def _skills_of(arrow: Arrow, skills: Mapping[str, Any]) -> list[str]:
    """Return the skills of an arrow's events."""
    chosen: list[str] = []
    for name in (predicate.name for predicate in predicates_of(arrow)):
        if name not in skills:
            raise DeclarationError(
                f"automaton(): the event {name!r} has no skill; give one: "
                f"automaton({{{name!r}: 'a_skill', ...}}){suggest(name, skills, listed=False)}"
            )
        chosen += _names(skills[name])
    return chosen


def _checked_reward(reward: Any, where: str) -> Reward:
    """Return a reward of a machine's transition or state, checked."""
    number = isinstance(reward, int | float | np.integer | np.floating)
    if number and not isinstance(reward, bool) and abs(reward) <= LARGEST_REWARD:
        return float(reward)
    if callable(reward) and not isinstance(reward, type):
        function: Callable[[Step], Any] = reward
        return function
    raise DeclarationError(
        f"{where}: its reward is {short(reward)}; give a number of at most {LARGEST_REWARD:g}, "
        "or a function of a step"
    )


def _each_step(value: Any, named: Mapping[str, int]) -> dict[int, Reward]:
    """Return the rewards of each step by the machine's state; one reward is for all states."""
    where = "RewardMachine: each_step"
    if isinstance(value, Mapping):
        return {_number(k, named, "each_step"): _checked_reward(v, where) for k, v in value.items()}
    reward = _checked_reward(value, where)
    return {} if reward == 0.0 else dict.fromkeys(named.values(), reward)


def _states(value: Any, what: str) -> list[Any]:
    """Return the states in a set that a machine is given, checked."""
    if isinstance(value, str) or not isinstance(value, Collection):
        raise DeclarationError(
            f"RewardMachine: {what} is {short(value)}; give a set of states: {what}={{'done'}}"
        )
    return list(value)


def _number(name: Any, named: Mapping[str, int], what: str) -> int:
    """Return the number of a machine's state by its name."""
    if name not in named:
        raise DeclarationError(
            f"RewardMachine: {what} names the state {short(name)}, which no transition names; the "
            f"states are: {listed(tuple(named))}"
        )
    return named[name]
