"""The graph of logged calls: from where each call ended, the nearest calls that start there.

Value iteration on it is kernel-based reinforcement learning (Ormoneit & Sen 2002) over calls
(Sutton, Precup & Singh 1999): no model is learnt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from skillweave.collecting.skill_set import SkillSet
from skillweave.errors import RunError
from skillweave.notices import notice
from skillweave.planning.calls import CallLog
from skillweave.planning.goal import Goal
from skillweave.planning.machine import Readings, RewardMachine
from skillweave.planning.neighbours import SOFT, feature_maps, nearest, weights_of
from skillweave.planning.states import PlanningStates
from skillweave.types import Array

MOST_CALLS = 20_000
"""The most calls of a graph; of more, every so-many-th is used."""
MOST_SWEEPS = 2_000
TOLERANCE = 1e-4
"""Value iteration ends where no value changes by more than this share of the largest."""


@dataclass(frozen=True)
class Near:
    """The nearest calls of each choice to n observations."""

    calls: Array
    """(n, choices, K) int64, rows of the graph."""
    weights: Array
    """(n, choices, K) float32, they add up to 1 for each choice."""
    distance: Array
    """(n, choices) float32, to the nearest."""
    total: Array
    """(n, choices) float32, the sum of the weights before they were normalised."""


@dataclass(frozen=True)
class Judged:
    """The outcome of every call of a graph for a task, from each of its M planning states."""

    reward: Array
    """(R, M) float32, Σ γᵏ rₖ within the call."""
    follows: Array
    """(R, M, J) int64, planning states at the call's end."""
    weights: Array
    """(R, M, J) float32, of these."""
    discount: Array
    """(R,) float32, γ^τ, or 0 where the episode terminated."""


class CallGraph:
    """R calls of a log and their nearest successors.

    Where lengths are chosen, a call also counts as one of each shorter length, up to its own: the
    steps inside say where it would have ended.

    Args:
        log: the calls.
        features: for all skills or by skill: places, or a function of observations; None: what each
            skill sees.
        neighbours: K.
        skills: for initiation sets in observations that are not in the log; None: those that were
            recorded at the ends of calls.

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
    ) -> None:
        if len(log) < 2:
            raise RunError(
                f"the log has {len(log)} call{'s' * (len(log) != 1)}, and nothing can be planned "
                "from that; record some thousand steps"
            )
        self.log, self.neighbours, self.skills = log, neighbours, skills
        self.call, self.tau, self.choice = _rows(log, skills)
        if len(self.call) > MOST_CALLS:
            notice(
                f"the log has {len(self.call):,} calls; the plan uses {MOST_CALLS:,} of them, at "
                "equal distances"
            )
            some = np.linspace(0, len(self.call) - 1, MOST_CALLS).astype(np.int64)
            self.call, self.tau, self.choice = self.call[some], self.tau[some], self.choice[some]
        known = np.concatenate([log.start, log.end])
        self.maps = feature_maps(log.observation_space, features, log.sees, known, log.skills)
        self.rows = [np.flatnonzero(self.choice == c) for c in range(log.choices)]
        """The rows of each choice."""
        self.known = np.array([len(rows) > 0 for rows in self.rows])
        """(choices,) bool: the log has a call of the choice."""
        lengths = max(1, len(log.lengths))
        self.skill_of = np.arange(log.choices) // lengths
        starts = log.start[self.call]
        self.starts = [
            self.maps[self.skill_of[c]](starts[rows]) if len(rows) else np.zeros((0, 1), np.float32)
            for c, rows in enumerate(self.rows)
        ]
        """Standardised features of each choice's starts, (n, F) float32."""
        whole = self.tau == log.tau[self.call]
        self.ends_call = log.offset[self.call] + self.tau - 1
        self.end = log.next_obs[self.ends_call]
        """(R, *obs_shape), the observation at each row's end."""
        self.terminated = log.terminated[self.call] & whole
        self.may = self._may(whole)
        """(R, choices) bool: the choices that may follow."""
        self._near: Near | None = None

    def near(self, obs: Array) -> Near:
        """Return the nearest calls of each choice to observations (n, …)."""
        return self.near_features([each(obs) for each in self.maps])

    def near_features(self, features: list[Array]) -> Near:
        """Return the nearest calls to features of each skill, (n, F) each."""
        n, k = len(features[0]), self.neighbours
        shape = (n, self.log.choices, k)
        calls, distance = np.zeros(shape, np.int64), np.full(shape, np.inf, np.float32)
        for c, rows in enumerate(self.rows):
            if len(rows):
                near, far = nearest(self.starts[c], features[self.skill_of[c]], k)
                calls[:, c], distance[:, c] = rows[near], far
                if len(rows) < k:  # the others repeat the last
                    distance[:, c, len(rows) :] = np.inf
        finite = np.where(np.isfinite(distance), distance, 1e9)
        total = (1.0 / (finite + SOFT)).sum(2)
        return Near(calls, weights_of(finite), distance[:, :, 0], total)

    @property
    def after(self) -> Near:
        """The nearest calls to the end of each call."""
        if self._near is None:
            self._near = self.near(self.end)
        return self._near

    def judge(
        self, task: RewardMachine, readings: Readings, gamma: float, over: Array | None = None
    ) -> Judged:
        """Return what each call pays and leads to, from each planning state of a task.

        Args:
            task: the machine.
            readings: the task's, of all steps of the log.
            gamma: γ of one step.
            over: (R,) bool, the calls after which nothing follows; None: where the episode
                terminated.
        """
        over = self.terminated if over is None else over
        states = PlanningStates(task)
        count, slots = states.count, task.slots
        reward = np.zeros((len(self.call), count), np.float32)
        final = np.zeros((len(self.call), count, 1 + slots), np.int64)
        # Rows of one call share its steps; the longest calls come first, so that those which go on
        # are always a part from the beginning.
        calls, longest = np.unique(self.call), np.zeros(len(self.log), np.int64)
        np.maximum.at(longest, self.call, self.tau)
        calls = calls[np.argsort(-longest[calls], kind="stable")]
        place = np.zeros(len(self.log), np.int64)
        place[calls] = np.arange(len(calls))
        by_tau = np.argsort(self.tau, kind="stable")
        bounds = np.searchsorted(self.tau[by_tau], np.arange(int(self.tau.max()) + 2))
        state = np.repeat(states.exact[None], len(calls), 0)
        paid = np.zeros((len(calls), count))
        lengths = longest[calls]
        for k in range(int(self.tau.max())):
            m = int(np.searchsorted(-lengths, -k, side="left"))  # calls with more than k steps
            some = readings.take(self.log.offset[calls[:m]] + k)
            state[:m], now = task.advance(state[:m], some)
            paid[:m] += gamma**k * now
            rows = by_tau[bounds[k + 1] : bounds[k + 2]]
            reward[rows], final[rows] = paid[place[self.call[rows]]], state[place[self.call[rows]]]
        follows, weights = states.corners(final)
        discount = gamma ** self.tau.astype(np.float64) * ~over
        return Judged(reward, follows, weights, discount.astype(np.float32))

    def solve(
        self,
        judged: Judged,
        near: Near,
        may: Array,
        *,
        caution: float = 0.0,
        novel: float | None = None,
        bonus: float = 1.0,
    ) -> tuple[Array, int]:
        """Return the value of each call from each planning state, (R, M), and the sweeps.

        The value of a call is y = R + γ^τ V(end), with V the largest, over choices, of the weighted
        mean of its nearest calls' values.

        Args:
            judged: what calls pay and lead to.
            near: the nearest calls to the ends.
            may: (R, choices) bool, what may follow.
            caution: share by which a value falls for each unit of distance to the nearest call.
            novel: distance from which on a choice is new, and worth ``bonus``; None: none is.
            bonus: its value.
        """
        rows = np.arange(len(self.call))[:, None, None]
        value = np.zeros(judged.reward.shape, np.float32)
        y = judged.reward
        trust = 1.0 / (1.0 + caution * near.distance)
        chosen = [c for c in range(self.log.choices) if self.known[c] or novel is not None]
        sweeps = 0
        for sweep in range(MOST_SWEEPS):
            following = (value[rows, judged.follows] * judged.weights).sum(2)
            y = judged.reward + judged.discount[:, None] * following
            best = np.full_like(value, -np.inf)
            for c in chosen:
                q = self._mean(y, near, c)
                q = np.where(q > 0, q * trust[:, c, None], q)
                if novel is not None:
                    q = np.where((near.distance[:, c] > novel)[:, None], np.float32(bonus), q)
                np.maximum(best, q, out=best, where=may[:, c, None])
            best[~np.isfinite(best)] = 0.0  # no choice may follow, or none that is known
            change = np.abs(best - value).max(initial=0.0)
            value, sweeps = best, sweep + 1
            if change <= TOLERANCE * max(np.abs(value).max(initial=0.0), 1e-12):
                break
        following = (value[rows, judged.follows] * judged.weights).sum(2)
        y = judged.reward + judged.discount[:, None] * following
        return y.astype(np.float32), sweeps

    def _mean(self, y: Array, near: Near, choice: int) -> Array:
        """Return the weighted mean of a choice's nearest calls, (R, M)."""
        total = np.zeros((len(near.calls), y.shape[1]), np.float32)
        for k in range(near.calls.shape[2]):
            total += near.weights[:, choice, k, None] * y[near.calls[:, choice, k]]
        return total

    def for_goal(self, goal: Goal, place: Array) -> tuple[Near, Array]:
        """Return neighbours of the calls' ends, and what may follow, where the goal is ``place``.

        They differ from the usual ones only for skills that see the goal.
        """
        if goal.columns is None:
            return self.after, self.may
        end = goal.put(self.end, place)
        features = [each(end) for each in self.maps]
        usual = [each(self.end) for each in self.maps]
        same = all(np.array_equal(a, b) for a, b in zip(features, usual, strict=True))
        may = self.may
        if self.skills is not None and self.skills.restricts:
            may = self.skills.startable(end)
        return (self.after if same else self.near_features(features)), may

    def _may(self, whole: Array) -> Array:
        may = self.log.may_follow[self.call].copy()
        part = np.flatnonzero(~whole)
        if len(part) and self.skills is not None and self.skills.restricts:
            may[part] = self.skills.startable(self.end[part])
        return may


def _rows(log: CallLog, skills: SkillSet | None) -> tuple[Array, Array, Array]:
    """Return the call, the steps and the choice of each row: calls, and their beginnings.

    A beginning counts as a call of a shorter length only where it is known what may follow.
    """
    call, tau, choice = np.arange(len(log)), log.tau, log.choice
    if not log.lengths or (skills is None and not log.may_follow.all()):
        return call, tau, choice
    rows = [(call, tau, choice)]
    count, length = len(log.lengths), log.choice % len(log.lengths)
    for i, steps in enumerate(log.lengths):
        longer = np.flatnonzero(length > i)
        rows.append((longer, np.minimum(tau[longer], steps), log.skill[longer] * count + i))
    joined = [np.concatenate(parts) for parts in zip(*rows, strict=True)]
    return joined[0], joined[1], joined[2]
