"""Forecasts of plans: episodes that follow a plan along logged calls, before it is played."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skillweave.errors import RunError
from skillweave.planning.calls import CallLog
from skillweave.planning.graph import CallGraph
from skillweave.planning.handover import wilson
from skillweave.planning.lacking import names_of, read_log
from skillweave.planning.machine import RewardMachine, predicates_of
from skillweave.planning.planner import Planner
from skillweave.policies.plan import Readings
from skillweave.policies.planned import SLACK
from skillweave.spaces import leaves
from skillweave.types import Array

EPISODES = 200
GOALS = 16
"""Episodes where each has a goal of its own, which needs a plan of its own."""
EQUAL = 10
"""Times K neighbors are looked at, as many calls may start in the same place."""
MOST_CALLS = 100
"""The most calls of an episode."""
UNLIKELY = 0.2
"""The chance below which the reason is given."""
FAR = 2.0
"""A call is unsure where the nearest logged one is so many times as far as is usual."""
OFTEN = 0.2
"""The share of a skill's calls from which on it is named as unsure."""
SHOWN = 6
"""Calls of the intended order that are shown."""


@dataclass(frozen=True)
class Forecast:
    """The calls that a plan intends, and how its episodes probably end.

    Attributes:
        calls: (skill, mean steps) in the most frequent order of calls, of the episodes that succeed
            if there are any; calls of one skill in a row count as one.
        chance: of success; None: the task has no accepting state.
        interval: of the chance, 95 %, by the number of starts in the log.
        steps: the mean steps of these episodes.
        unsure: the skills that are often called where the log has no call of them near.
        reason: why the chance is small; empty: it is not.
    """

    calls: tuple[tuple[str, float], ...]
    chance: float | None
    interval: tuple[float, float]
    steps: float
    unsure: tuple[str, ...]
    reason: str

    def __str__(self) -> str:
        """Return all of it as a line."""
        names = [f"{name} ({steps:.0f} steps)" for name, steps in self.calls[:SHOWN]]
        text = " -> ".join([*names, "..."] if len(self.calls) > SHOWN else names)
        if self.chance is not None:
            low, high = self.interval
            text += f": a chance of {self.chance:.0%} ({low:.0%} to {high:.0%})"
        text += f", about {self.steps:.0f} steps"
        if self.unsure:
            text += f"; unsure, as the log has few calls near there: {', '.join(self.unsure)}"
        return f"{text}; {self.reason}" if self.reason else text


def forecast(planner: Planner) -> Forecast:
    """Return how episodes of a plan probably go.

    From logged starts, each choice is the plan's; then one of the nearest logged calls is drawn by
    its weight, and followed to its end. Numbers that never change within an episode stay those of
    the start. So the chance is that of the plan, not the largest of several noisy values.

    Raises:
        RunError: the log has no start of an episode.
    """
    graph, machine, observed = planner.graph, planner.machine, planner.observed
    log = graph.log
    rng = np.random.default_rng(0)
    starts = np.flatnonzero(planner.log.order == 0)
    if not len(starts):
        raise RunError("the log has no start of an episode, so no plan can be judged by it")
    n = EPISODES if observed is None else GOALS
    before = log.before
    first = planner.log.start[starts[np.arange(n) * len(starts) // n]]
    fixed = [(a == b).all(0) for a, b in zip(*map(leaves, (before, log.next_obs)), strict=True)]
    limit = planner.log.time_limit or np.inf
    known = read_log(machine, log)
    obs, state, elapsed = first.copy(), machine.start(n), np.zeros(n, np.int64)
    may, running = np.ones((n, log.choices), bool), np.ones(n, bool)
    if graph.skills is not None:
        may = graph.skills.hierarchy.may_start(first)
    # Of each call the skill (−1: none), its steps, and how far the nearest logged one was.
    history = np.full((MOST_CALLS, 3, n), -1.0)
    for calls in history:
        here, until = np.flatnonzero(running), elapsed.copy()
        was = state[here]
        at, may_here = np.arange(len(here)), may[here] | ~may[here].any(1, keepdims=True)
        option, near = planner.options(obs[here], state[here], may_here, rng)
        wide = graph.near(obs[here], EQUAL * graph.neighbors)
        weights = wide.weights[at, option]
        # Beyond the plan's K neighbors those count that are as near as the last of these.
        weights = weights * (weights >= 0.999 * weights[:, graph.neighbors - 1, None])
        drawn = weights.cumsum(1) < rng.random((len(here), 1)) * weights.sum(1, keepdims=True)
        piece = wide.pieces[at, option, np.minimum(drawn.sum(1), weights.shape[1] - 1)]
        far = near.distance[at, option] / graph.options.units[option]
        step, end = graph.pieces.first[piece], graph.end_of[piece]
        goes_on = np.isfinite(far)
        while goes_on.any():
            some, steps = here[goes_on], step[goes_on]
            readings = known.take(steps)
            if observed is not None:  # the goal is that of the episode, not of the logged call
                there = observed.holds(log.next_obs[steps], observed.of(first[some]))
                readings.events[:, 0] = there
            state[some] = machine.acts.advance(state[some], readings)[0]
            elapsed[some] += 1
            step += goes_on
            goes_on &= (step <= graph.end_step[end]) & (elapsed[here] < limit)
            goes_on &= ~machine.is_over(state[here])
        calls[:, here] = graph.options.skills[option], (elapsed - until)[here], far
        over = machine.is_over(state[here]) | (elapsed[here] >= limit) | ~np.isfinite(far)
        running[here[over | planner.over[end]]] = False
        if not running.any():
            break
        # A call that led nowhere is not chosen again at once, as the episode's calls count, too.
        begins = before[graph.pieces.first[piece]]
        off = np.maximum(_shift(graph, option, begins, obs[here]), SLACK)
        still = _shift(graph, option, begins, graph.end[end]) <= off
        stuck = still & (state[here] == was).all(1)
        may[here[~stuck]] = graph.may[end[~stuck]]
        may[here[stuck], graph.choice_of[option[stuck]]] = False
        obs[here[~still]] = graph.end[end[~still]]
        for own, start, same in zip(leaves(obs), leaves(first), fixed, strict=True):
            np.copyto(own, start, where=same)
    done = machine.has_succeeded(state)
    shown = done if done.any() else np.ones(n, bool)
    chance, reason = None, ""
    if machine.accepting.any():
        chance = 0.0 if planner.obstacle else float(done.mean())
        if chance < UNLIKELY:
            reason = planner.obstacle or _reason(machine, state[~done, 0], log, known)
    m = min(n, len(starts))
    low, high = wilson((chance or 0.0) * m, m)
    return Forecast(
        _usual_calls(history[:, :, shown], log.skills),
        chance,
        (float(low), float(high)),
        float(elapsed[shown].mean()),
        tuple(
            name
            for i, name in enumerate(log.skills)
            if (far := history[:, 2][history[:, 0] == i]).size and (far > FAR).mean() > OFTEN
        ),
        reason,
    )


def _shift(graph: CallGraph, option: Array, one: Array, other: Array) -> Array:
    """Return the distances (n,) between observations, as the skills of options see them."""
    shift, skill = np.zeros(len(option)), graph.options.skills[option]
    for i in np.unique(skill):
        mine, features = skill == i, graph.maps[i]
        shift[mine] = np.linalg.norm(features(one[mine]) - features(other[mine]), axis=1)
    return shift


def _usual_calls(history: Array, skills: tuple[str, ...]) -> tuple[tuple[str, float], ...]:
    """Return the most frequent order of skills, with the mean steps of each."""
    orders: dict[tuple[int, ...], list[Array]] = {}
    for skill, steps in zip(history[:, 0].T, history[:, 1].T, strict=True):
        called = np.flatnonzero(skill >= 0)
        first = called[np.diff(skill[called], prepend=-1) != 0]
        sums = np.add.reduceat(steps[: len(called)], first)
        orders.setdefault(tuple(skill[first].astype(int).tolist()), []).append(sums)
    order, steps = max(orders.items(), key=lambda item: len(item[1]))
    return tuple((skills[i], s) for i, s in zip(order, np.mean(steps, 0).tolist(), strict=True))


def _reason(machine: RewardMachine, state: Array, log: CallLog, known: Readings) -> str:
    """Return where most episodes end that fail, in these states (n,)."""
    begins = log.offset[:-1][log.order == 0]
    for arrow in machine.leaving[machine.acts.first]:
        if machine.failing[arrow.target]:
            numbers = [*map(machine.number, predicates_of(arrow))]
            holds = known.events[begins][:, numbers].all(1).mean()
            if holds > 0.5:
                bad = names_of([arrow])
                return f"{bad}, which is avoided, holds in {holds:.0%} of the first steps"
    stuck = machine.state_names[int(np.bincount(state).argmax())]
    return f"most episodes end in the state {stuck!r}"
