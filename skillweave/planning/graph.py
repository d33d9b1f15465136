"""The graph of logged calls: from where each call ended, the nearest calls that pass there.

Value iteration on it is kernel-based reinforcement learning (Ormoneit & Sen 2002) over calls
(Sutton, Precup & Singh 1999): no model is learnt.

A call is a chain of pieces of a few steps. A skill without a memory acts by what it sees, so from
any piece on, the call is also a call that started there; a logged call says what the skill does
from everywhere that it passed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from skillweave.collecting.skill_set import SkillSet
from skillweave.errors import RunError
from skillweave.notices import notice
from skillweave.planning.calls import CallLog
from skillweave.planning.compared import compared_places
from skillweave.planning.goal import GoalTask
from skillweave.planning.machine import Readings, RewardMachine
from skillweave.planning.neighbours import (
    BLOCK,
    SOFT,
    Standard,
    feature_maps,
    nearest,
    tie_order,
    weights_of,
)
from skillweave.planning.states import PlanningStates
from skillweave.policies.core import CallEnd
from skillweave.types import Array

PIECE = 5
"""Steps of a piece, where that does not give too many."""
MOST_PIECES = 10_000
"""The most pieces of a graph; of a longer log they have more steps."""
MOST_CALLS = 20_000
"""The most calls of a graph; of more, every so-many-th is used."""
CANDIDATES = 32
"""The nearest calls of a skill with goals, whose goals are the options."""
MOST_APART = 64
"""Goals up to which each is an option of its own everywhere, as another skill would be."""
FURTHER = 2.0
"""A neighbour counts only if it is at most so many times as far as the nearest, or as is usual:
where the log has few calls, others are often behind a wall, and a small chance to pass it would
grow with each call that is tried again."""
SAMPLED = 500
"""Starts by which it is measured what is usual."""
MOST_SWEEPS = 2_000
TOLERANCE = 1e-4
"""Value iteration ends where no value changes by more than this share of the largest."""


@dataclass(frozen=True)
class Near:
    """The nearest pieces of each option to n observations, each of another call.

    An option is a choice; of a skill with goals, a choice with one of the logged goals.
    """

    pieces: Array
    """(n, O, K) int64."""
    weights: Array
    """(n, O, K) float32, they add up to 1 for each option."""
    distance: Array
    """(n, O) float32, to the nearest."""
    total: Array
    """(n, O) float32, the sum of the weights before they were normalised."""
    goal: Array
    """(n, O) int64, the call whose goal the option has; −1: it has none."""

    def take(self, rows: Array) -> Near:
        """Return the neighbours of some observations."""
        parts = (self.pieces, self.weights, self.distance, self.total, self.goal)
        return Near(*(part[rows] for part in parts))


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
    then: Array
    """(P,) int64, the next piece of the same call; −1: the call ends."""


@dataclass(frozen=True)
class Judged:
    """The outcome of every piece for a task, from each of its M planning states."""

    reward: Array
    """(P, M) float32, Σ γᵏ rₖ within the piece."""
    follows: Array
    """(P, M, J) int32, planning states after it."""
    weights: Array
    """(P, M, J) float32, of these."""
    discount: Array
    """(P,) float32, γ to the number of steps; 0 where nothing follows."""


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
        neighbours: K.
        skills: for initiation sets in observations that are not in the log; None: those that were
            recorded at the ends of calls.
        task: that will be planned, as far as it is known; see ``compared_places``.

    Raises:
        RunError: the log has less than two calls.
        DeclarationError: features are constant or not finite, or have a wrong shape.
    """

    def __init__(
        self,
        log: CallLog,
        features: Any = None,
        neighbours: int = 5,
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
            log = log.take(np.linspace(0, len(log) - 1, MOST_CALLS).astype(np.int64))
        self.log, self.neighbours, self.skills = log, neighbours, skills
        self.pieces = pieces = _pieces(log, skills)
        known = np.concatenate([log.start, log.end])
        space = log.observation_space
        places = compared_places(log, task)
        self.maps = feature_maps(space, features, places, known, log.skills)
        self._of_choice = [np.flatnonzero(pieces.choice == c) for c in range(log.choices)]
        self.skill_of = np.arange(log.choices) // max(1, len(log.lengths))
        self.goals = [_standard_goals(log, name) for name in log.skills]
        """Of each skill, (C, G) float32 standardised goals of its calls; None: it has none."""
        starts = log.before[pieces.first]
        self._starts = [
            self.maps[skill](starts[rows]) if len(rows) else np.zeros((0, 1), np.float32)
            for skill, rows in zip(self.skill_of, self._of_choice, strict=True)
        ]
        self._options = [self._options_of(c) for c in range(log.choices)]
        counts = [options.count for options in self._options]
        self.choice_of = np.repeat(np.arange(log.choices), counts)
        """(O,) int64, the choice of each option."""
        self.known = np.repeat([len(rows) > 0 for rows in self._of_choice], counts)
        """(O,) bool: the log has a call of the option's choice."""
        last = pieces.then < 0
        steps, self._end_of = np.unique(pieces.stop[last] - 1, return_inverse=True)
        self._last = np.flatnonzero(last)
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
        self._end_features = [each(self.end) for each in self.maps]
        self._depths = _by_depth(pieces.then)
        self._after: Near | None = None

    @property
    def groups(self) -> list[tuple[int, OptionGroup]]:
        """All options in their order: the choice, and options of it that share their calls."""
        return [
            (choice, group)
            for choice, options in enumerate(self._options)
            for group in options.groups(self.neighbours)
        ]

    def near(self, obs: Array, most: int = 0) -> Near:
        """Return the nearest pieces of each choice to observations (n, …): K, or ``most``."""
        return self.near_features([each(obs) for each in self.maps], most)

    def near_features(self, features: list[Array], most: int = 0) -> Near:
        """Return the nearest pieces to features of each skill, (n, F) each: K, or ``most``."""
        return self._near([features[skill] for skill in self.skill_of], most=most)

    def _near(self, features: list[Array], without: Array | None = None, most: int = 0) -> Near:
        """Return the nearest pieces to features for each choice, (n, F) each.

        Args:
            without: (n,) calls whose pieces do not count.
            most: how many, each of another call; 0: K.
        """
        found = [
            options.near(to, most or self.neighbours, without)
            for options, to in zip(self._options, features, strict=True)
        ]
        pieces, distance, goal = (np.concatenate(part, 1) for part in zip(*found, strict=True))
        finite = np.where(np.isfinite(distance), distance, 1e9)
        total = (1.0 / (finite + SOFT)).sum(2)
        return Near(pieces, weights_of(finite), distance[:, :, 0], total, goal)

    def trust(self, distance: Array, caution: float) -> Array:
        """Return the share of a value that is left where the nearest piece is far, (n, O) float32.

        Args:
            distance: (n, O), to the nearest piece of each option; infinite: it has none.
            caution: the share by which a value falls, about, where this distance is the usual one
                of the K-th neighbour.
        """
        far = np.where(np.isfinite(distance), distance, 0.0) / self.units
        share: Array = (1.0 / (1.0 + caution * far)).astype(np.float32)
        return share

    @cached_property
    def units(self) -> Array:
        """The usual distance of the K-th neighbour of each option, (O,) float32.

        Where the log has too few calls to tell, it is 1, a standard deviation.
        """
        each = np.array([group.usual for _, group in self.groups], np.float32)
        each = np.where(np.isfinite(each), np.maximum(each, SOFT), np.float32(1.0))
        return each.repeat([group.options for _, group in self.groups])

    @cached_property
    def end_of(self) -> Array:
        """The end of the call that each piece is of, (P,) int64."""
        end = np.empty(len(self.pieces.call), np.int64)
        end[self._last] = self._end_of
        for rows in self._depths:
            end[rows] = end[self.pieces.then[rows]]
        return end

    def _options_of(self, choice: int) -> Options:
        """Return the options of a choice."""
        rows, starts = self._of_choice[choice], self._starts[choice]
        call, goals = self.pieces.call[rows], self.goals[self.skill_of[choice]]
        if goals is None or not len(rows):
            return Apart(rows, starts, call, np.zeros(len(rows), np.int64), np.array([-1]))
        _, one, which = np.unique(goals[call], axis=0, return_index=True, return_inverse=True)
        if len(one) <= MOST_APART and 2 * len(one) <= len(np.unique(call)):
            return Apart(rows, starts, call, which.reshape(-1), call[one])
        return ByGoal(rows, starts, call, goals[call])

    @property
    def after(self) -> Near:
        """The nearest pieces to the ends of calls."""
        if self._after is None:
            self._after = self._without_own(self.near_features(self._end_features))
        return self._after

    def _goes_on(self, call: Array) -> Array:
        """Return whether other logged calls say how each of these calls would have gone on."""
        calls = np.bincount(self.log.choice, minlength=self.log.choices)
        return (
            ~np.array(self.log.recurrent)[self.log.skill[call]] & (calls > 1)[self.log.choice[call]]
        )

    def _without_own(self, near: Near) -> Near:
        """Return the neighbours where no cut call is followed by its own pieces."""
        cut = self._cut
        if not len(cut):
            return near
        call = self.end_call[cut]
        features = [self._end_features[skill][cut] for skill in self.skill_of]
        others = self._near(features, call)
        # Only the cut skill may follow.
        rows, options = np.nonzero(self.choice_of == self.log.choice[call][:, None])
        for name in ("pieces", "weights", "distance", "goal"):
            getattr(near, name)[cut[rows], options] = getattr(others, name)[rows, options]
        return near

    def judge(
        self,
        task: RewardMachine,
        states: PlanningStates,
        readings: Readings,
        gamma: float,
        over: Array,
    ) -> Judged:
        """Return what each piece pays and leads to, from each planning state of a task.

        Args:
            task: the machine.
            states: its planning states.
            readings: the machine's, of all steps of the log.
            gamma: γ of one step.
            over: (E,) bool, the ends after which nothing follows.
        """
        pieces = self.pieces
        steps = pieces.stop - pieces.first
        # The longest come first, so that those which go on are always a part from the beginning.
        order = np.argsort(-steps, kind="stable")
        first, lengths = pieces.first[order], steps[order]
        state = np.repeat(states.exact[None], len(order), 0)
        paid = np.zeros((len(order), states.count))
        for k in range(int(lengths[0])):
            m = int(np.searchsorted(-lengths, -k, side="left"))
            state[:m], now = task.advance(state[:m], readings.take(first[:m] + k))
            paid[:m] += gamma**k * now
        reward, final = np.empty(paid.shape, np.float32), np.empty_like(state)
        reward[order], final[order] = paid, state
        follows, weights = states.corners(final)
        used = np.flatnonzero(weights.any((0, 1)))  # exact levels need one corner alone
        discount = gamma ** steps.astype(np.float64)
        discount[self._last] *= ~over[self._end_of]
        return Judged(
            reward, follows[..., used].astype(np.int32), weights[..., used],
            discount.astype(np.float32),
        )  # fmt: skip

    def solve(
        self,
        judged: Judged,
        near: Near,
        may: Array,
        *,
        caution: float = 0.0,
        novel: Array | None = None,
        bonus: float = 1.0,
    ) -> tuple[Array, int]:
        """Return the worth of each piece from each planning state, (P, M), and the sweeps.

        A piece is worth what it pays and what follows: the next piece of its call, or at the call's
        end the best choice, by the weighted mean of its nearest pieces' worth.

        Args:
            judged: what pieces pay and lead to.
            near: the nearest pieces to the ends.
            may: (E, choices) bool, what may follow.
            caution: see ``trust``.
            novel: (O,), the distance from which on each option is new, and worth ``bonus``; None:
                none is.
            bonus: its value.
        """
        count = judged.reward.shape[1]
        value = np.zeros((len(self.end), count), np.float32)
        trust = self.trust(near.distance, caution)
        options = np.flatnonzero(self.known | (novel is not None)).tolist()
        allowed = may[:, self.choice_of]
        if novel is None:
            allowed &= np.isfinite(near.distance)
        for sweeps in range(1, MOST_SWEEPS + 1):  # noqa: B007
            worth = self._worth(judged, value)
            best = np.full_like(value, -np.inf)
            for c in options:
                q = np.zeros_like(value)
                for k in range(self.neighbours):
                    q += near.weights[:, c, k, None] * worth[near.pieces[:, c, k]]
                q = np.where(q > 0, q * trust[:, c, None], q)
                if novel is not None:
                    q = np.where((near.distance[:, c] > novel[c])[:, None], np.float32(bonus), q)
                np.maximum(best, q, out=best, where=allowed[:, c, None])
            best[~np.isfinite(best)] = 0.0  # no choice may follow, or none that is known
            change, largest = np.abs(best - value).max(initial=0.0), np.abs(best).max(initial=0.0)
            value = best
            if change <= TOLERANCE * largest:
                break
        return self._worth(judged, value), sweeps

    def _worth(self, judged: Judged, value: Array) -> Array:
        """Return the worth of pieces, (P, M), where the ends of calls have a ``value`` (E, M)."""
        worth = np.zeros(judged.reward.shape, np.float32)

        def put(rows: Array, following: Array, place: Array) -> None:
            after = following[place[:, None, None], judged.follows[rows]]
            mean = (after * judged.weights[rows]).sum(2)
            worth[rows] = judged.reward[rows] + judged.discount[rows, None] * mean

        put(self._last, value, self._end_of)
        for rows in self._depths:
            put(rows, worth, self.pieces.then[rows])
        return worth

    def for_goal(self, goal: GoalTask, place: Array) -> tuple[Near, Array]:
        """Return the nearest pieces to the ends, and what may follow, where the goal is ``place``.

        They differ from the usual ones only for skills that see the goal.
        """
        if goal.columns is None:
            return self.after, self.may
        end = goal.put(self.end, place)
        features = [each(end) for each in self.maps]
        same = all(np.array_equal(a, b) for a, b in zip(features, self._end_features, strict=True))
        may = self.may
        if self.skills is not None and self.skills.hierarchy.restricts:
            may = self.skills.hierarchy.may_start(end)
        return (self.after if same else self.near_features(features)), may


@dataclass(frozen=True)
class OptionGroup:
    """Options whose calls count for one another: one, or the goals of the nearest calls."""

    options: int
    """How many."""
    rows: Array
    """(m,) the pieces of their calls."""
    starts: Array
    """(m, F) float32, the features of their starts."""
    goal: Array
    """(m,) the call with the goal that an option has if the piece is its nearest; −1: none."""
    usual: float
    """The usual distance of a start's k-th neighbour among others."""


class Options:
    """The options of one choice: the calls of a skill, perhaps with goals.

    Args:
        rows: (m,) the choice's pieces.
        starts: (m, F) float32, the features of their starts.
        call: (m,) the call of each.
    """

    count: int
    """The number of options."""

    def __init__(self, rows: Array, starts: Array, call: Array) -> None:
        self._rows, self._starts, self._call = rows, starts, call

    def near(self, to: Array, k: int, without: Array | None) -> tuple[Array, Array, Array]:
        """Return the nearest pieces to features ``to`` (n, F).

        Args:
            k: how many, each of another call.
            without: (n,) calls whose pieces do not count; None: all count.

        Returns:
            Pieces (n, options, k), distances (n, options, k), infinite where there are fewer; and
            the calls whose goals the options have, (n, options), −1: none.
        """
        raise NotImplementedError

    def groups(self, k: int) -> list[OptionGroup]:
        """Return the options in their order, with the pieces that count for them, by tie order."""
        raise NotImplementedError

    def _nearest(
        self, mine: Array, to: Array, k: int, without: Array | None
    ) -> tuple[Array, Array]:
        """Return the nearest of the places ``mine`` (m,), (n, k), and distances (n, k)."""
        if not len(mine):
            return np.zeros((len(to), k), np.int64), np.full((len(to), k), np.inf, np.float32)
        call = self._call[mine]
        more = k if without is None else k + 1
        near, far = nearest(self._starts[mine], to, more, call)
        if without is not None:
            far[call[near] == without[:, None]] = np.inf
            order = np.argsort(far, axis=1, kind="stable")[:, :k]
            near, far = np.take_along_axis(near, order, 1), np.take_along_axis(far, order, 1)
        return mine[near], far


def _sampled(places: Array) -> Array:
    """Return some places (m,), at equal distances."""
    return places[np.linspace(0, len(places) - 1, min(len(places), SAMPLED)).astype(np.int64)]


def _without_far(far: Array, usual: float) -> Array:
    """Return distances (…, k), infinite where they are too far to count."""
    limit = FURTHER * np.maximum(far[..., :1], np.float32(usual))
    return np.where(far <= limit, far, np.float32(np.inf))


class Apart(Options):
    """Options whose calls do not count for one another: one, or a few goals.

    Args:
        which: (m,) the option of each piece.
        goal: (options,) a call with the goal of each; −1: it has none.
    """

    def __init__(self, rows: Array, starts: Array, call: Array, which: Array, goal: Array) -> None:
        super().__init__(rows, starts, call)
        self.count, self._goal = len(goal), goal
        self._mine = [np.flatnonzero(which == option) for option in range(len(goal))]
        self._usual: dict[int, list[float]] = {}

    def near(self, to: Array, k: int, without: Array | None) -> tuple[Array, Array, Array]:
        """Return the nearest pieces of each goal; see ``Options.near``."""
        found = []
        for mine, usual in zip(self._mine, self.usual(k), strict=True):
            places, far = self._nearest(mine, to, k, without)
            found.append((places, _without_far(far, usual)))
        places, far = (np.stack(part, 1) for part in zip(*found, strict=True))
        pieces = self._rows[places] if len(self._rows) else places
        return pieces, far, np.repeat(self._goal[None], len(to), axis=0)

    def groups(self, k: int) -> list[OptionGroup]:
        """Return a group for each option; see ``Options.groups``."""
        groups = []
        for some, goal, usual in zip(self._mine, self._goal, self.usual(k), strict=True):
            mine = some[tie_order(len(some))]
            goals = np.full(len(mine), goal)
            groups.append(OptionGroup(1, self._rows[mine], self._starts[mine], goals, usual))
        return groups

    def usual(self, k: int) -> list[float]:
        """Return the usual distance of each option's k-th neighbour."""
        if k not in self._usual:
            self._usual[k] = [self._usually(mine, k) for mine in self._mine]
        return self._usual[k]

    def _usually(self, mine: Array, k: int) -> float:
        """Return the median distance of a start's k-th neighbour among others."""
        some = _sampled(mine)
        if not len(some):
            return np.inf
        far = self._nearest(mine, self._starts[some], k, self._call[some])[1]
        return float(np.median(far[:, -1]))


class ByGoal(Options):
    """The goals of the nearest calls, whose calls count for one another by start and goal.

    Args:
        goals: (m, G) float32, the standardised goals of the pieces.
    """

    def __init__(self, rows: Array, starts: Array, call: Array, goals: Array) -> None:
        super().__init__(rows, starts, call)
        self.count, self._goals = CANDIDATES, goals
        self._all = np.arange(len(rows))
        self._usual: dict[int, float] = {}

    def near(self, to: Array, k: int, without: Array | None) -> tuple[Array, Array, Array]:
        """Return the pieces that are nearest by start and goal; see ``Options.near``."""
        pieces, far, goal = self._near(to, k, without)
        return pieces, _without_far(far, self.usual(k)), goal

    def groups(self, k: int) -> list[OptionGroup]:
        """Return one group, of all options; see ``Options.groups``."""
        mine = tie_order(len(self._rows))
        rows, starts, call = self._rows[mine], self._starts[mine], self._call[mine]
        return [OptionGroup(self.count, rows, starts, call, self.usual(k))]

    def usual(self, k: int) -> float:
        """Return the usual distance of an option's k-th neighbour."""
        if k not in self._usual:
            some = _sampled(self._all)
            far = self._near(self._starts[some], k, self._call[some])[1][:, :, -1]
            self._usual[k] = float(np.median(far))
        return self._usual[k]

    def _near(self, to: Array, k: int, without: Array | None) -> tuple[Array, Array, Array]:
        """Return the nearest pieces as ``near`` does, however far they are."""
        shape = (len(to), CANDIDATES, k)
        pieces, far = np.zeros(shape, np.int64), np.full(shape, np.inf, np.float32)
        goal = np.full(shape[:2], -1)
        step = max(1, BLOCK // CANDIDATES**2)
        for first in range(0, len(to), step):
            some = slice(first, first + step)
            skipped = None if without is None else without[some]
            near, off = self._nearest(self._all, to[some], CANDIDATES, skipped)
            goals = torch.from_numpy(self._goals[near])
            # Differences: those of squares are wrong by rounding where goals are near.
            exact = "donot_use_mm_for_euclid_dist"
            apart = torch.cdist(goals, goals, compute_mode=exact).square().numpy()
            both = np.sqrt(off[:, None] ** 2 + apart)  # (n, candidates, calls)
            least = np.argsort(both, axis=2, kind="stable")[:, :, :k]
            most = least.shape[2]
            far[some, :, :most] = np.take_along_axis(both, least, 2)
            own = np.take_along_axis(near[:, None].repeat(CANDIDATES, 1), least, 2)
            pieces[some, :, :most] = self._rows[own]
            missing = ~np.isfinite(off)
            far[some][missing] = np.inf
            goal[some] = np.where(missing, -1, self._call[near])
        return pieces, far, goal


def _standard_goals(log: CallLog, skill: str) -> Array | None:
    """Return the goals of all calls, standardised by those of a skill's calls, (C, G) float32."""
    goals, mine = log.goals.get(skill), log.skill == log.number(skill)
    if goals is None:
        return None
    if not mine.any():
        return np.zeros(goals.shape, np.float32)
    return np.where(mine[:, None], Standard(goals[mine])(goals), 0.0).astype(np.float32)


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
    then = np.where(last, -1, np.arange(len(call)) + 1)
    return Pieces(call, log.choice[call], first, stop, then)


def _beginnings(log: CallLog, skills: SkillSet | None) -> Pieces:
    """Return calls, and their beginnings as calls of shorter lengths.

    A beginning counts only where it is known what may follow.
    """
    parts = [(np.arange(len(log)), log.tau, log.choice)]
    count, length = len(log.lengths), log.choice % len(log.lengths)
    if skills is not None or log.may_follow.all():
        for i, steps in enumerate(log.lengths):
            longer = np.flatnonzero(length > i)
            tau = np.minimum(log.tau[longer], steps)
            parts.append((longer, tau, log.skill[longer] * count + i))
    call, tau, choice = (np.concatenate(column) for column in zip(*parts, strict=True))
    first = log.offset[call]
    return Pieces(call, choice, first, first + tau, np.full(len(call), -1))


def _by_depth(then: Array) -> list[Array]:
    """Return pieces before the last of a call: those whose next one is known come first."""
    depth = np.zeros(len(then), np.int64)
    rows = np.flatnonzero(then >= 0)
    for row in rows[::-1]:  # the next piece has the next number
        depth[row] = depth[then[row]] + 1
    order = rows[np.argsort(depth[rows], kind="stable")]
    bounds = np.flatnonzero(np.diff(depth[order])) + 1
    return [part for part in np.split(order, bounds) if len(part)]
