"""The graph of logged calls: from where each call ended, the nearest calls that pass there.

Value iteration on it is kernel-based reinforcement learning (Ormoneit & Sen 2002) over calls
(Sutton, Precup & Singh 1999): no model is learnt.

A call is a chain of pieces of a few steps. A skill without a memory acts by what it sees, so from
any piece on, the call is also a call that started there; a logged call says what the skill does
from everywhere that it passed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from skillweave._internal.notices import notice
from skillweave.calls.compared import feature_maps
from skillweave.calls.log import CallLog
from skillweave.calls.neighbors import Standard, evenly, tie_order
from skillweave.errors import DeclarationError, RunError
from skillweave.planning.fixed import needs_fixed
from skillweave.planning.goal import GoalTask
from skillweave.planning.lacking import check_possible, read_log
from skillweave.planning.machine import RewardMachine
from skillweave.policies.core import Array, CallEnd
from skillweave.policies.plan import (
    MOST_COUNTERS,
    Levels,
    Near,
    OptionGroup,
    Options,
    Readings,
)
from skillweave.skills.skill_set import SkillSet

LEVELS = 128
"""The most levels of a counter."""
FEWEST_LEVELS = 8
ENOUGH_STATES = 256
"""Counters have fewer levels where there would be more states."""
MOST_STATES = 3_000
PIECE = 5
"""Steps of a piece, where that does not give too many."""
MOST_PIECES = 30_000
"""The most pieces of a graph; of a longer log they have more steps."""
MOST_CALLS = 20_000
"""The most calls of a graph; of more, every so-many-th is used."""
CANDIDATES = 32
"""The nearest calls of a skill with goals, whose goals are the options."""
MOST_APART = 64
"""Goals up to which each is an option of its own everywhere, as another skill would be."""
SAMPLED = 500
"""Starts by which it is measured what is usual."""
MOST_SWEEPS = 2_000
TOLERANCE = 1e-4
"""Value iteration ends where no value changes by more than this share of the largest."""


@dataclass(frozen=True)
class Pieces:
    """P pieces of calls."""

    call: Array
    """(P,) int64, the call that each is of."""
    choice: Array
    """(P,) int64."""
    first: Array
    """(P,) int64, its first step in the log."""
    stop: Array
    """(P,) int64, the step behind its last one."""
    last: Array
    """(P,) bool: its call ends with it; else the next piece goes on."""


class CallGraph:
    """The pieces of a log's calls, and the nearest pieces to where each call ended.

    Where lengths are chosen, a call also counts as one of each shorter length: the steps inside say
    where it would have ended.

    A skill with goals is chosen with a logged goal. Where the log has few of them, each is an
    option as another skill would be. Where it has many, the goals of the nearest calls are the
    options, and a call counts for another goal by the distance of start and goal.

    Args:
        log: the calls.
        features: for all skills or by skill: places, or a function of observations; None: see
            ``compared_places``.
        neighbors: K.
        skills: for initiation sets in observations that are not in the log; None: those that were
            recorded at the ends of calls.
        task: the task that will be planned, as far as it is known; see ``needs_fixed``.

    Raises:
        RunError: the log has less than two calls.
        DeclarationError: features are constant or not finite, or have a wrong shape.
    """

    def __init__(
        self,
        log: CallLog,
        features: Any = None,
        neighbors: int = 5,
        skills: SkillSet | None = None,
        task: RewardMachine | None = None,
    ) -> None:
        if len(log) < 2:
            raise RunError(
                f"the log has {len(log)} call{'s' * (len(log) != 1)}, and nothing can be planned "
                "from that; record some thousand steps"
            )
        if len(log) > MOST_CALLS:
            notice(
                f"the log has {len(log):,} calls; the plan uses {MOST_CALLS:,} of them, at equal "
                "distances"
            )
            log = log.take(evenly(np.arange(len(log)), MOST_CALLS))
        self.log = log
        self.neighbors = neighbors
        self.skills = skills
        self.pieces = pieces = _pieces(log, skills)
        known = np.concatenate([log.start, log.end])
        keep = task is not None and needs_fixed(task, log)
        self.maps = [*feature_maps(log, features, known, keep_fixed=keep).values()]
        aims = [_standard_goals(log, name) for name in log.skills]
        groups = tuple(self._groups(log.before[pieces.first], aims))
        self.options = Options(groups, tuple(aims), neighbors, log.lengths)
        self.choice_of = self.options.choice_of
        """(O,) int64, the choice of each option."""
        self.known = np.bincount(pieces.choice, minlength=log.choices)[self.choice_of] > 0
        """(O,) bool: the log has a call of the option's choice."""
        self._last = np.flatnonzero(pieces.last)
        steps, end = np.unique(pieces.stop[self._last] - 1, return_inverse=True)
        each = np.arange(len(pieces.last))
        at = np.searchsorted(self._last, each)
        self.end_of = end[at]
        """(P,) int64, the end of the call that each piece is of."""
        depth = self._last[at] - each
        self._depths = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
        """Pieces before the last of a call: those whose next one is known come first."""
        self.end_step = steps
        """(E,) int64, the last step before each end."""
        self.end = log.next_obs[steps]
        """(E, *obs_shape), the observations at the ends of calls."""
        call = log.owner[steps]
        whole = steps == log.offset[call + 1] - 1
        self.end_call = call
        """(E,) int64, the call of each end."""
        self.terminated = log.terminated[call] & whole
        """(E,) bool: the episode terminated there."""
        self.may = log.may_follow[call].copy()
        """(E, choices) bool: what may follow."""
        # A call that was cut would have gone on: its skill alone may follow.
        cut = log.was_cut | (log.end_reason == CallEnd.INTERRUPTED)
        self._cut = np.flatnonzero(cut[call] & whole & self._goes_on(call))
        own = log.choice[call[self._cut]]
        self.may[self._cut] = own[:, None] == np.arange(log.choices)
        parts = np.flatnonzero(~whole)
        if len(parts) and skills is not None and skills.hierarchy.restricts:
            self.may[parts] = skills.hierarchy.may_start(self.end[parts])
        self._end_features = [features(self.end) for features in self.maps]

    def near(self, obs: Array) -> Near:
        """Return the nearest pieces of each choice to observations (n, …)."""
        return self.options.near([each(obs) for each in self.maps])

    def _groups(self, starts: Array, aims: list[Array | None]) -> Iterator[OptionGroup]:
        """Yield the options of all choices, by groups that share their calls.

        Args:
            starts: (P, *obs_shape), the observations in which pieces start.
            aims: of each skill, the standardised goals of all calls; None: it has none.
        """
        for choice in range(self.log.choices):
            skill = self.log.skill_of(choice)
            own = aims[skill]
            rows = np.flatnonzero(self.pieces.choice == choice)
            call = self.pieces.call[rows]
            features = self.maps[skill](starts[rows]) if len(rows) else np.zeros((0, 1), np.float32)
            which = np.zeros(len(rows), np.int64)
            one = np.array([-1])
            count = 1
            if own is not None and len(rows):
                _, one, which = np.unique(own[call], axis=0, return_index=True, return_inverse=True)
                one = call[one]
                which = which.reshape(-1)
                if not are_apart(len(one), len(np.unique(call))):
                    one = np.array([-1])
                    which = np.zeros_like(which)
                    count = CANDIDATES
            for i, goal in enumerate(one):
                alike = np.flatnonzero(which == i)
                mine = alike[tie_order(len(alike))]
                goals = np.full(len(mine), goal) if count == 1 else call[mine]
                group = OptionGroup(
                    choice, count, rows[mine], features[mine], call[mine], goals, float("inf")
                )
                if len(alike):
                    some = evenly(alike, SAMPLED)
                    far = group.near(features[some], self.neighbors, own, call[some])[1]
                    group.usual = float(np.median(far[:, :, -1]))
                yield group

    @cached_property
    def after(self) -> Near:
        """The nearest pieces to the ends of calls."""
        return self._without_own(self.options.near(self._end_features))

    def _goes_on(self, call: Array) -> Array:
        """Return whether other logged calls say how each of these calls would have gone on."""
        calls = np.bincount(self.log.choice, minlength=self.log.choices)
        return (
            ~np.array(self.log.recurrent)[self.log.skill[call]] & (calls > 1)[self.log.choice[call]]
        )

    def _without_own(self, near: Near) -> Near:
        """Return the neighbors where no cut call is followed by its own pieces."""
        cut = self._cut
        if not len(cut):
            return near
        call = self.end_call[cut]
        others = self.options.near([each[cut] for each in self._end_features], without=call)
        # Only the cut skill may follow.
        rows, options = np.nonzero(self.choice_of == self.log.choice[call][:, None])
        for name in ("pieces", "weights", "distance", "goal"):
            getattr(near, name)[cut[rows], options] = getattr(others, name)[rows, options]
        return near

    def solve(
        self,
        task: RewardMachine,
        gamma: float,
        over: Array,
        near: Near,
        may: Array,
        *,
        caution: float = 0.0,
        novel: Array | None = None,
    ) -> Array:
        """Return the worth of each piece from each planning state of a task, (P, M).

        A piece is worth what it pays and what follows: the next piece of its call, or at the call's
        end the best choice, by the weighted mean of its nearest pieces' worth.

        Args:
            task: the machine.
            gamma: γ of one step.
            over: (E,) bool, the ends after which nothing follows.
            near: the nearest pieces to the ends.
            may: (E, choices) bool, what may follow.
            caution: see ``Options.trust``.
            novel: (O,), the distance from which on each option is new, and worth 1; None: none
                is.

        Raises:
            RunError: see ``read_log`` and ``check_possible``.
        """
        readings = read_log(task, self.log)
        check_possible(task, readings, self.log)
        worth_of = self._judged(task, readings, gamma, over)
        trust = self.options.trust(near.distance, caution)
        options = np.flatnonzero(self.known | (novel is not None)).tolist()
        allowed = may[:, self.choice_of]
        if novel is None:
            allowed &= np.isfinite(near.distance)
        value = np.zeros((len(self.end), planning_states(task).count), np.float32)
        for _ in range(MOST_SWEEPS):
            worth = worth_of(value)
            best = np.full_like(value, -np.inf)
            for c in options:
                q = np.zeros_like(best)
                for k in range(self.neighbors):
                    q += near.weights[:, c, k, None] * worth[near.pieces[:, c, k]]
                q = np.where(q > 0, q * trust[:, c, None], q)
                if novel is not None:
                    q = np.where((near.distance[:, c] > novel[c])[:, None], np.float32(1.0), q)
                np.maximum(best, q, out=best, where=allowed[:, c, None])
            best[~np.isfinite(best)] = 0.0  # no choice may follow, or none that is known
            change = np.abs(best - value).max(initial=0.0)
            largest = np.abs(best).max(initial=0.0)
            value = best
            if change <= TOLERANCE * largest:
                break
        return worth_of(value)

    def _judged(
        self, task: RewardMachine, readings: Readings, gamma: float, over: Array
    ) -> Callable[[Array], Array]:
        """Return a function: of the ends' values (E, M) to the worth of pieces, (P, M) float32."""
        states = planning_states(task)
        steps = self.pieces.stop - self.pieces.first
        # The longest come first, so that those which go on are always a part from the beginning.
        order = np.argsort(-steps, kind="stable")
        first = self.pieces.first[order]
        lengths = steps[order]
        state = np.repeat(exact_states(states)[None], len(order), 0)
        paid = np.zeros((len(order), states.count))
        for k in range(int(lengths[0])):
            m = int(np.searchsorted(-lengths, -k, side="left"))
            state[:m], now = task.acts.advance(state[:m], readings.take(first[:m] + k))
            paid[:m] += gamma**k * now
        reward = np.empty(paid.shape, np.float32)
        final = np.empty_like(state)
        reward[order] = paid
        final[order] = state
        follows, weights = states.corners(final)
        used = np.flatnonzero(weights.any((0, 1)))  # exact levels need one corner alone
        follows = follows[..., used].astype(np.int32)
        weights = weights[..., used]
        discount = gamma ** steps.astype(np.float64)
        discount[self._last] *= ~over[self.end_of[self._last]]
        discounts: Array = discount.astype(np.float32)[:, None]

        def worth_of(value: Array) -> Array:
            """Return the worth of all pieces (P, M), of the values of ends."""
            worth: Array = np.zeros_like(reward)
            ends = self.end_of[self._last]
            parts = [(self._last, value, ends), *((rows, worth, rows + 1) for rows in self._depths)]
            for rows, following, place in parts:
                after = following[place[:, None, None], follows[rows]]
                mean = (after * weights[rows]).sum(2)
                worth[rows] = reward[rows] + discounts[rows] * mean
            return worth

        return worth_of

    def for_goal(self, goal: GoalTask, place: Array) -> tuple[Near, Array]:
        """Return the nearest pieces to the ends, and what may follow, where the goal is ``place``.

        They differ from the usual ones only for skills that see the goal.
        """
        end = goal.put(self.end, place)
        features = [each(end) for each in self.maps]
        same = all(np.array_equal(a, b) for a, b in zip(features, self._end_features, strict=True))
        may = self.may
        if self.skills is not None and self.skills.hierarchy.restricts:
            may = self.skills.hierarchy.may_start(end)
        return (self.after if same else self.options.near(features)), may


def are_apart(goals: int, calls: int) -> bool:
    """Return whether a skill's goals are few enough for each to be an option of its own."""
    return goals <= MOST_APART and 2 * goals <= calls


def goal_standard(log: CallLog, skill: str) -> Standard | None:
    """Return the scale of a skill's goals by its calls; None: it has no goals, or no call."""
    goals = log.goals.get(skill)
    mine = log.skill == log.number(skill)
    return None if goals is None or not mine.any() else Standard(goals[mine])


def _standard_goals(log: CallLog, skill: str) -> Array | None:
    """Return the goals of all calls, standardised by those of a skill's calls, (C, G) float32."""
    goals = log.goals.get(skill)
    mine = log.skill == log.number(skill)
    if goals is None:
        return None
    if (standard := goal_standard(log, skill)) is None:
        return np.zeros(goals.shape, np.float32)
    return np.where(mine[:, None], standard(goals), 0.0).astype(np.float32)


def _pieces(log: CallLog, skills: SkillSet | None) -> Pieces:
    """Return the pieces of calls; where lengths are chosen, calls and their beginnings."""
    if log.lengths:
        return _beginnings(log, skills)
    steps = max(PIECE, -(-log.steps // MOST_PIECES))
    # A skill with a memory would act otherwise if it was called in the middle.
    forgets = ~np.array(log.recurrent, bool)[log.skill]
    counts = np.where(forgets, -(-log.tau // steps), 1)
    call = np.repeat(np.arange(len(log)), counts)
    number = np.arange(len(call)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = log.offset[call] + number * steps
    last = number == counts[call] - 1
    stop = np.where(last, log.offset[call + 1], first + steps)
    return Pieces(call, log.choice[call], first, stop, last)


def _beginnings(log: CallLog, skills: SkillSet | None) -> Pieces:
    """Return calls, and their beginnings as calls of shorter lengths.

    A beginning counts only where it is known what may follow.
    """
    parts = [(np.arange(len(log)), log.tau, log.choice)]
    count = len(log.lengths)
    length = log.choice % len(log.lengths)
    if skills is not None or log.may_follow.all():
        for i, steps in enumerate(log.lengths):
            longer = np.flatnonzero(length > i)
            tau = np.minimum(log.tau[longer], steps)
            parts.append((longer, tau, log.skill[longer] * count + i))
    call, tau, choice = (np.concatenate(column) for column in zip(*parts, strict=True))
    first = log.offset[call]
    return Pieces(call, choice, first, first + tau, np.ones(len(call), bool))


# The finite states that a task is planned in


def planning_states(task: RewardMachine) -> Levels:
    """Return M states for planning: those of a machine, each with all levels of its counters.

    Raises:
        DeclarationError: there would be more than 3,000, or a state has more than four counters.
    """
    if task.slots > MOST_COUNTERS:
        raise DeclarationError(
            f"the task waits for {task.slots} events that must hold for several steps at once; "
            f"at most {MOST_COUNTERS} can be planned"
        )
    used = task.counter_steps < np.iinfo(np.int64).max
    steps = np.where(used, task.counter_steps, 1)
    most = LEVELS
    while most > FEWEST_LEVELS and np.minimum(steps, most).prod(1).sum() > ENOUGH_STATES:
        most //= 2
    levels = np.minimum(steps, most)
    spacing = np.where(used, (steps - 1) / np.maximum(levels - 1, 1), 1.0)
    sizes = levels.prod(1)
    states = Levels(levels, spacing, np.cumsum(sizes) - sizes)
    if states.count > MOST_STATES:
        raise DeclarationError(
            f"the task has {states.count:,} states with the levels of its counters; at most "
            f"{MOST_STATES:,} can be planned: repeat it less often"
        )
    return states


def exact_states(states: Levels) -> Array:
    """Return the task's state that each planning state is, (M, 1 + H)."""
    q = np.repeat(np.arange(len(states.first)), states.levels.prod(1))
    place = np.arange(states.count) - states.first[q]
    exact = np.zeros((states.count, 1 + states.levels.shape[1]), np.int64)
    exact[:, 0] = q
    for slot in reversed(range(states.levels.shape[1])):
        count = states.levels[q, slot]
        exact[:, 1 + slot] = np.round(place % count * states.spacing[q, slot])
        place //= count
    return exact
