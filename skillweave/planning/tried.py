"""The calls of a running episode, which count beside the logged ones when a plan acts.

A call that failed would else be chosen again and again: it is not in the log. Stands alone because
it is a memory, and planning is a function of the log.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave.planning.graph import CallGraph, Near
from skillweave.planning.neighbours import SOFT
from skillweave.policies.core import CallEnd, LastCall
from skillweave.types import Array, Memory

LATEST = 16
"""The calls of an episode that are remembered."""
TRUST = 20.0
"""Logged calls for which one of the episode counts at the same distance: it says what happens here,
while logged calls may have started behind a wall."""
SLACK = 0.03
"""A call of the episode counts where it is nearer than any logged one, but for so much."""


class Tried:
    """The latest calls of n episodes, as arrays of a selector's memory.

    Each has the choice, its goal, the features of its start and its end (for every skill), its
    steps, what it paid, γ^τ, the task's planning states before and after it, and what the log says
    of each option at its end.

    Args:
        graph: the logged calls.
    """

    def __init__(self, graph: CallGraph) -> None:
        self._skill_of, self._choice_of = graph.skill_of, graph.choice_of
        self._goals = graph.goals
        sizes = [goals.shape[1] for goals in graph.goals if goals is not None]
        self._goal_size = max(sizes, default=1)
        self._lengths = np.array(graph.log.lengths)
        self._skills = len(graph.maps)
        self._size = max(each.size for each in graph.maps)

    def start(self, n: int) -> Memory:
        """Return the memory of ``n`` episodes without a call."""
        calls, options = (n, LATEST), len(self._choice_of)
        return {
            "tried.count": np.zeros(n, np.int64),
            "tried.choice": np.full(calls, -1),
            "tried.steps": np.zeros(calls, np.int64),
            "tried.start": np.zeros((*calls, self._skills, self._size), np.float32),
            "tried.end": np.zeros((*calls, self._skills, self._size), np.float32),
            "tried.reward": np.zeros(calls),
            "tried.discount": np.ones(calls),
            "tried.from": np.full(calls, -1),
            "tried.to": np.full(calls, -1),
            "tried.q": np.zeros((*calls, options), np.float32),
            "tried.total": np.zeros((*calls, options), np.float32),
            "tried.far": np.zeros((*calls, options), np.float32),
            "tried.may": np.zeros((*calls, options), bool),
            "tried.goal": np.zeros((*calls, self._goal_size), np.float32),
            "tried.goals": np.zeros((*calls, options, self._goal_size), np.float32),
        }

    def goals_of(self, near: Near) -> Array:
        """Return the standardised goals of options, (n, O, G); 0 where they have none."""
        found = np.zeros((*near.goal.shape, self._goal_size), np.float32)
        for skill, goals in enumerate(self._goals):
            if goals is not None:
                mine = np.flatnonzero(self._skill_of[self._choice_of] == skill)
                call = near.goal[:, mine]
                own = np.where(call[..., None] >= 0, goals[call], 0.0)
                found[:, mine, : goals.shape[1]] = own
        return found

    def padded(self, features: list[Array]) -> Array:
        """Return the features of each skill, (n, F) each, as one array (n, S, F)."""
        whole = np.zeros((len(features[0]), self._skills, self._size), np.float32)
        for skill, some in enumerate(features):
            whole[:, skill, : some.shape[1]] = some
        return whole

    def begin(
        self, memory: Memory, features: Array, goal: Array, choice: Array, place: Array
    ) -> Memory:
        """Add the calls that were chosen, (n,), in the task's planning states ``place`` (n,).

        Args:
            goal: (n, G) standardised; NaN: unknown, so that the call counts for none.
        """
        rows, slot = np.arange(len(choice)), memory["tried.count"] % LATEST
        new = {
            "tried.choice": choice,
            "tried.steps": 0,
            "tried.start": features,
            "tried.goal": goal,
            "tried.reward": 0.0,
            "tried.discount": 1.0,
            "tried.from": place,
            "tried.to": -1,
        }
        return _put(memory, new, rows, slot) | {"tried.count": memory["tried.count"] + 1}

    def pay(self, memory: Memory, reward: Array, gamma: float, last: LastCall) -> Memory:
        """Add a step's rewards (n,) of the task to the running calls, which ``last`` describes.

        A planner that only guides did not make the choices: they are those of the selector beside
        it.
        """
        rows, slot = np.arange(len(reward)), (memory["tried.count"] - 1) % LATEST
        discount = memory["tried.discount"][rows, slot]
        steps, chosen = memory["tried.steps"][rows, slot] + 1, memory["tried.choice"][rows, slot]
        choice = self._called(chosen, steps, last)
        with_goal = np.array([goals is not None for goals in self._goals])
        other = (self._skill_of[np.maximum(chosen, 0)] != last.skill) & with_goal[last.skill]
        goal = np.where(other[:, None], np.nan, memory["tried.goal"][rows, slot])
        new = {
            "tried.choice": choice,
            "tried.goal": goal,
            "tried.steps": steps,
            "tried.reward": memory["tried.reward"][rows, slot] + discount * reward,
            "tried.discount": discount * gamma,
        }
        return _put(memory, new, rows, slot)

    def _called(self, choice: Array, steps: Array, last: LastCall) -> Array:
        """Return the choices (n,) that the calls are of, after this number of their steps."""
        other = self._skill_of[np.maximum(choice, 0)] != last.skill
        if not len(self._lengths):
            return np.where(other, last.skill, choice)
        # Which length another selector has chosen is known where the call has reached it.
        count, at = len(self._lengths), np.searchsorted(self._lengths, steps)
        length = np.where(other | (last.why == CallEnd.LIMIT), at, choice % count)
        called: Array = last.skill * count + np.minimum(length, count - 1)
        return called

    def end(
        self, memory: Memory, features: Array, goals: Array, q: Array, near: Near, place: Array,
        may: Array,
    ) -> Memory:  # fmt: skip
        """Complete the latest calls, where they end in an observation.

        Args:
            features: (n, S, F) of the observation.
            goals: (n, O, G) of the options there.
            q: (n, O), what the log says there.
            near: the nearest logged calls.
            place: (n,) planning states of the task.
            may: (n, choices) bool, what may be chosen.
        """
        slot = (memory["tried.count"] - 1) % LATEST
        rows = np.flatnonzero(memory["tried.count"] > 0)
        new = {
            "tried.end": features[rows],
            "tried.to": place[rows],
            "tried.q": q[rows],
            "tried.total": near.total[rows],
            "tried.far": near.distance[rows],
            "tried.may": may[rows][:, self._choice_of],
            "tried.goals": goals[rows],
        }
        return _put(memory, new, rows, slot[rows])

    def corrected(
        self, memory: Memory, features: Array, goals: Array, q: Array, near: Near, place: Array
    ) -> Array:
        """Return values (n, O) for which the episode's own calls count as logged ones.

        Args:
            features: (n, S, F) of the present observation.
            goals: (n, O, G) of the options there.
            q: (n, O), what the log says there.
            near: the nearest logged calls.
            place: (n,) planning states of the task.
        """
        choice, n = memory["tried.choice"], len(q)
        # Ends of calls, and last the present: there values are wanted.
        where = np.concatenate([memory["tried.end"], features[:, None]], 1)
        states = np.concatenate([memory["tried.to"], place[:, None]], 1)
        same = (states[:, :, None] == memory["tried.from"][:, None]) & (choice >= 0)[:, None]
        skill = self._skill_of[np.maximum(choice, 0)]
        to = where[np.arange(n)[:, None], :, skill].swapaxes(1, 2)  # (n, ends, calls, F)
        start = memory["tried.start"][np.arange(n)[:, None], np.arange(LATEST), skill]
        far = np.sqrt(np.square(to - start[:, None]).sum(3))[..., None]
        if any(own is not None for own in self._goals):
            # (n, ends, calls, O): an option counts by its goal, too.
            known = np.concatenate([memory["tried.goals"], goals[:, None]], 1)
            off = known[:, :, None] - memory["tried.goal"][:, None, :, None]
            far = np.sqrt(far**2 + np.square(off).sum(4))
        # The distance of the nearest logged call of each option, (n, ends, O).
        nearest = np.concatenate([memory["tried.far"], near.distance[:, None]], 1)
        of = choice[:, None, :, None] == self._choice_of
        counts = same[..., None] & of & (far <= nearest[:, :, None] + SLACK)
        if not counts[:, -1].any():
            return q
        weight = np.where(counts, TRUST / (far + SOFT), 0.0)
        own = weight.sum(2)
        logged = np.concatenate([memory["tried.q"], q[:, None]], 1)
        total = np.concatenate([memory["tried.total"], near.total[:, None]], 1)
        known = np.isfinite(logged)
        total = np.where(known, total, 0.0)
        base = np.where(known, logged, 0.0) * total
        both = np.where(known | (own > 0), np.maximum(total + own, 1e-12), np.inf)
        missing = ~known & (own <= 0)
        may = memory["tried.may"]
        # From what was not tried: a call that led back to its start would else be worth itself.
        value = _best(np.where(own > 0, -np.inf, logged)[:, :-1], may)
        for _ in range(LATEST):
            y = memory["tried.reward"] + memory["tried.discount"] * value
            q_all = (base + np.einsum("neco,nc->neo", weight, y)) / both
            q_all = np.where(missing, -np.inf, q_all)
            value = _best(q_all[:, :-1], may)
        corrected: Array = q_all[:, -1].astype(np.float32)
        return corrected


def _best(q: Array, may: Array) -> Array:
    """Return the largest value among what may be chosen, (n, calls); 0 where nothing is known."""
    best = np.where(may, q, -np.inf).max(-1)
    return np.where(np.isfinite(best), best, 0.0)


def _put(memory: Memory, values: Mapping[str, Any], rows: Array, slot: Array) -> Memory:
    """Return copies of some of a memory's arrays, with values in one slot of each row."""
    changed: Memory = {}
    for name, value in values.items():
        changed[name] = memory[name].copy()
        changed[name][rows, slot] = value
    return changed
