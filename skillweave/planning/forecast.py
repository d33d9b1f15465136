"""Forecasts of plans: episodes that follow a plan along logged calls, before it is played.

A plan without goals chooses among few skills, and follows any logged calls. One with goals chooses
among many goals, and the best of them is often the luckiest: its own calls say too much good of it.
So episodes of the log are also split into halves: a goal is chosen by one, and the calls of the
other are followed. They are fewer and farther away, and say too little good of it. The chance is
the mean of both, and the interval reaches from the lower bound of these to the upper one of those.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from skillweave.calls.handover import wilson
from skillweave.calls.log import CallLog
from skillweave.calls.neighbors import evenly, nearest
from skillweave.errors import RunError
from skillweave.planning.graph import are_apart, goal_standard
from skillweave.planning.lacking import names_of, read_log
from skillweave.planning.machine import RewardMachine, predicates_of
from skillweave.planning.planner import Planner
from skillweave.policies.core import Array, CallEnd, LastCall, Turn, World
from skillweave.policies.plan import SOFT, Readings
from skillweave.policies.planned import SLACK, Planned
from skillweave.spaces import leaves

EPISODES = 200
GOALS = 16
"""Episodes where each has a goal of its own, which needs a plan of its own."""
FEWEST_EPISODES = 4
"""Episodes of a log from which on its halves judge one another."""
FOLLOWED = 5
"""The nearest calls, of which one is followed; more where others are as near as the last."""
EQUAL = 10
"""Times as many are looked at."""
SAME = 1e-3
"""Distances that differ by less are equal."""
MOST_CALLS = 100
"""The most calls of an episode."""
UNLIKELY = 0.2
"""The chance below which the reason is given."""
FAR = 2.0
"""Times the usual distance beyond which a logged call says nothing."""
OFTEN = 0.2
"""The share of a skill's calls from which on it is named as unsure."""
SHOWN = 6
"""Calls of the intended order that are shown."""
SAMPLED = 500
"""Calls by which it is measured what distance is usual."""
RARE = 0.1
"""The share of episodes below which a step of the plan does not count to the interval."""
OTHER_GOAL = np.float32(1e4)
"""The distance of goals that are compared as different skills are."""


@dataclass(frozen=True)
class Forecast:
    """The calls that a plan intends, and how its episodes probably end.

    Attributes:
        calls: (skill, mean steps) in the most frequent order of calls, of the episodes that succeed
            if there are any; calls of one skill in a row count as one, unless it has goals.
        chance: of success; None: the task has no accepting state, or the log cannot say.
        interval: of the chance, 95 %, by the logged calls at the step of the plan that has the
            fewest. Where skills have goals, it reaches from the lower bound by calls that the plan
            did not choose by, to the upper bound by all.
        steps: the mean steps of these episodes.
        unsure: the skills that are often called where the log has no call of them near.
        reason: why the chance is small or unknown; empty: it is neither.
        goals: of each of the calls, its goals in words; empty: it has none.
        already: the words of the mission that hold before anything is done; empty: none does.
        episodes: the number of played ones, whose share the chance is; 0: none.
    """

    calls: tuple[tuple[str, float], ...]
    chance: float | None
    interval: tuple[float, float]
    steps: float
    unsure: tuple[str, ...]
    reason: str
    goals: tuple[str, ...] = ()
    already: str = ""
    episodes: int = 0

    def __str__(self) -> str:
        """Return the forecast as a line."""
        goals = self.goals or ("",) * len(self.calls)
        names = [
            f"{name}{goal and ' '}{goal} ({steps:.0f} steps)"
            for (name, steps), goal in zip(self.calls, goals, strict=True)
        ]
        text = " -> ".join([*names[:SHOWN], "..."] if len(names) > SHOWN else names)
        low, high = self.interval
        if self.episodes and self.chance is not None:
            text += f": done in {self.chance:.0%} of {self.episodes} played episodes"
            text += f" ({low:.0%} to {high:.0%})"
        elif self.chance is not None:
            text += f": a chance of {self.chance:.0%} ({low:.0%} to {high:.0%})"
        elif self.reason:
            text += ": no known chance"
        text += f", about {self.steps:.0f} steps"
        if self.unsure:
            text += f"; unsure, as the log has few calls near there: {', '.join(self.unsure)}"
        return "; ".join([text, *filter(None, (self.reason, self.already))])


@dataclass
class _Followed:
    """N episodes that followed a plan, with at most C calls each."""

    skill: Array
    """(C, N) int64; −1: none."""
    steps: Array
    """(C, N) int64."""
    call: Array
    """(C, N) int64, the logged call that was followed; −1: none was near."""
    aim: Array
    """(C, N) int64, the logged call whose goal it had; −1: it had none."""
    state: Array
    """(C, N) int64, of the task before the call."""
    last: Array
    """(N,) int64, the state of the task at the end."""
    done: Array
    """(N,) bool."""
    known: Array
    """(N,) bool: the log had a call near wherever one was needed."""

    @property
    def evidence(self) -> float:
        """The logged calls by which the scarcest step of the plan was judged.

        A step is a skill in a state of the task. Calls that many episodes followed say no more
        than one does, so the number is that of equally used calls (Kish 1965).
        """
        fewest = np.inf
        used = self.call >= 0
        for step in np.unique(np.stack([self.state[used], self.skill[used]]), axis=1).T:
            calls = self.call[used & (self.state == step[0]) & (self.skill == step[1])]
            if len(calls) >= RARE * len(self.done):
                uses = np.bincount(calls).astype(float)
                fewest = min(fewest, uses.sum() ** 2 / np.square(uses).sum())
        return float(fewest) if np.isfinite(fewest) else 0.0

    def chance(self, starts: int) -> tuple[float, float, float]:
        """Return the share of episodes that are done, and the bounds of its interval.

        An episode that the log does not cover counts neither way, for the lower bound as failed,
        for the upper one as done.

        Args:
            starts: the logged starts that they are from.
        """
        n = min(self.evidence, starts)
        low, _ = wilson(self.done.mean() * n, n)
        _, high = wilson((self.done | ~self.known).mean() * n, n)
        return float(self.done.sum() / max(1, self.known.sum())), float(low), float(high)


class _Calls:
    """Logged calls that are followed.

    Args:
        planner: of the whole log.
        some: (C,) bool, these calls.
    """

    def __init__(self, planner: Planner, some: Array) -> None:
        self._graph = graph = planner.graph
        log, pieces = graph.log, graph.pieces
        starts = log.before[pieces.first]
        self._of: list[tuple[Array, Array, float]] = []
        """The pieces of each choice, their starts, and the usual distance of others."""
        for choice in range(log.choices):
            rows = np.flatnonzero((pieces.choice == choice) & some[pieces.call])
            usual = 0.0
            points = np.zeros((0, 1), np.float32)
            if len(rows):
                points = self._points(choice, starts[rows], pieces.call[rows])
                few = points[evenly(np.arange(len(rows)), SAMPLED)]
                far = nearest(points, few, graph.neighbors + 1, pieces.call[rows])[1]
                usual = float(np.median(far[:, -1]))
            # Too few calls to tell: a standard deviation.
            self._of.append((rows, points, max(usual, SOFT) if np.isfinite(usual) else 1.0))

    def _points(self, choice: int, obs: Array, aim: Array) -> Array:
        """Return numbers by which calls are compared, (n, F) float32: of their start and goal.

        Args:
            choice: of all these calls.
            obs: (n, *obs_shape).
            aim: (n,), the calls of the log that have the goals.
        """
        log = self._graph.log
        skill = log.skill_of(choice)
        name = log.skills[skill]
        features: Array = self._graph.maps[skill](obs)
        standard = goal_standard(log, name)
        if standard is None:
            return features
        mine = log.goals[name][log.choice == choice]
        apart = are_apart(len(np.unique(mine, axis=0)), len(mine))
        goals = standard(log.goals[name][aim]) * (OTHER_GOAL if apart else 1.0)
        points: Array = np.concatenate([features, goals], 1, dtype=np.float32)
        return points

    def like(self, choice: int, obs: Array, aim: Array, rng: np.random.Generator) -> Array:
        """Return a piece of a call near by start and goal, (n,) int64; −1: none is near.

        Args:
            choice: the calls' choice.
            obs: (n, *obs_shape).
            aim: (n,), the calls of the log that have the goals; −1: it has none.
            rng: the source of chance.
        """
        rows, points, usual = self._of[choice]
        if not len(rows):
            return np.full(len(obs), -1)
        calls = self._graph.pieces.call[rows]
        near, far = nearest(points, self._points(choice, obs, aim), EQUAL * FOLLOWED, calls)
        counts = (far <= far[:, FOLLOWED - 1, None] + SAME) & np.isfinite(far)
        counts &= far <= FAR * np.maximum(far[:, :1], usual)
        weights = np.where(counts, 1.0 / (far + SOFT), 0.0)
        drawn = weights.cumsum(1) < rng.random((len(obs), 1)) * weights.sum(1, keepdims=True)
        place = np.minimum(drawn.sum(1), near.shape[1] - 1)
        piece = rows[near[np.arange(len(obs)), place]]
        return np.where(far[:, 0] <= FAR * usual, piece, -1)


def forecast(planner: Planner) -> Forecast:
    """Return the forecast of a plan: how episodes that follow it along logged calls end.

    From logged starts, each choice is the plan's, as it would be played; then one of the nearest
    logged calls, by start and goal, is followed to its end. Calls that began too late before the
    time limit of their episode are not followed. Numbers that never change within an episode stay
    those of the start.

    Raises:
        RunError: the log has no start of an episode.
    """
    log = planner.graph.log
    machine = planner.machine
    starts = int((log.order == 0).sum())
    if not starts:
        raise RunError("the log has no start of an episode, so no plan can be judged by it")
    rng = np.random.default_rng(0)
    evidence = ~log.began_late
    whole = _follow(planner, planner.in_place, evidence, log.order == 0, rng)
    chance, reason = None, ""
    low, high = 0.0, 1.0
    if machine.accepting.any():
        chance, low, high = whole.chance(starts)
        if planner.log.goals:
            chance, low, high = _without_luck(planner, (chance, low, high), rng)
        if planner.obstacle:
            low, high = (float(x) for x in wilson(0.0, min(EPISODES, starts)))
            chance = 0.0
            reason = planner.obstacle
        elif chance is None or not whole.known.any():
            chance = None
            low = 0.0
            high = 1.0
            reason = _unknown(planner)
        elif chance < UNLIKELY:
            known = read_log(machine, log)
            reason = _reason(machine, whole.last[~whole.done], log, known)
    calls, goals = _usual_calls(planner, whole)
    shown = whole.done if whole.done.any() else np.ones_like(whole.done)
    return Forecast(
        calls,
        chance,
        (low, high),
        float(whole.steps.sum(0)[shown].mean()),
        tuple(
            name
            for i, name in enumerate(log.skills)
            if (mine := whole.skill == i).any() and (whole.call[mine] < 0).mean() > OFTEN
        ),
        reason,
        goals,
        planner.already,
    )


def played(expected: Forecast, done: int | None, episodes: int, steps: float) -> Forecast:
    """Return a forecast with the results of played episodes in place of the expected ones.

    Args:
        expected: before they were played.
        done: the episodes that succeeded; None: the task has no accepting state.
        episodes: the number that were played.
        steps: their mean steps.
    """
    share = None
    interval = (0.0, 1.0)
    if done is not None:
        low, high = wilson(done, episodes)
        share = done / episodes
        interval = (float(low), float(high))
    return replace(
        expected, chance=share, interval=interval, steps=steps, unsure=(), reason="",
        episodes=episodes,
    )  # fmt: skip


def _without_luck(
    planner: Planner, whole: tuple[float, float, float], rng: np.random.Generator
) -> tuple[float | None, float, float]:
    """Return the chance of a plan with goals, and its bounds.

    Args:
        planner: with the plan.
        whole: the chance by all calls, and its bounds.
        rng: the source of chance.

    Returns:
        They are None, 0 and 1 where the log has too few episodes.
    """
    log = planner.graph.log
    number = np.unique(log.episode, return_inverse=True)[1].reshape(-1)
    if number.max() + 1 < FEWEST_EPISODES:
        return None, 0.0, 1.0
    halves = []
    first = log.order == 0
    for half in (number % 2 == 0, number % 2 == 1):
        acting = copy.copy(planner.in_place)
        acting.options = planner.graph.options.of_calls(half)
        if (first & ~half).any():
            followed = _follow(planner, acting, ~half & ~log.began_late, first & ~half, rng)
            halves.append(followed.chance(int((first & ~half).sum())))
    held_out = np.mean(halves, 0)
    low, high = _pooled(halves)
    chance = (held_out[0] + whole[0]) / 2
    return float(chance), min(low, chance), max(high, whole[2], chance)


def _follow(
    planner: Planner, acting: Planned, some: Array, first_of: Array, rng: np.random.Generator
) -> _Followed:
    """Return episodes that follow a plan along logged calls.

    Args:
        planner: with the plan.
        acting: chooses.
        some: (C,) bool, the calls that may be followed.
        first_of: (C,) bool, the calls in whose starts episodes start.
        rng: the source of chance.
    """
    graph = planner.graph
    machine = planner.machine
    observed = planner.observed
    log = graph.log
    calls = _Calls(planner, some)
    starts = np.flatnonzero(first_of)
    n = EPISODES if observed is None else GOALS
    first = log.start[starts[np.arange(n) * len(starts) // n]]
    before = log.before
    fixed = [(a == b).all(0) for a, b in zip(*map(leaves, (before, log.next_obs)), strict=True)]
    limit = planner.log.time_limit or np.inf
    known = read_log(machine, log)
    obs = first.copy()
    memory = acting.start(n)
    elapsed = np.zeros(n, np.int64)
    may = np.ones((n, log.choices), bool)
    running = np.ones(n, bool)
    if graph.skills is not None:
        may = graph.skills.hierarchy.may_start(first)
    shape = (MOST_CALLS, n)
    history = _Followed(
        skill=np.full(shape, -1),
        steps=np.zeros(shape, np.int64),
        call=np.full(shape, -1),
        aim=np.full(shape, -1),
        state=np.full(shape, -1),
        last=np.zeros(n, np.int64),
        done=np.zeros(n, bool),
        known=np.ones(n, bool),
    )
    for number in range(MOST_CALLS):
        here = np.flatnonzero(running)
        may_here = may[here] | ~may[here].any(1, keepdims=True)
        history.state[number, here] = memory["state"][here]
        option, near = acting.decide(memory, here, obs[here], Turn(World(rng), may_here), True)
        choice = graph.choice_of[option]
        aim = near.goal[np.arange(len(here)), option]
        history.skill[number, here] = log.skill_of(choice)
        history.aim[number, here] = aim
        piece = np.full(len(here), -1)
        for one in np.unique(choice).tolist():
            mine = choice == one
            piece[mine] = calls.like(one, obs[here[mine]], aim[mine], rng)
        unknown = here[piece < 0]
        history.known[unknown] = running[unknown] = False
        here, choice, piece = (x[piece >= 0] for x in (here, choice, piece))
        if not len(here):
            break
        history.call[number, here] = graph.pieces.call[piece]
        step = graph.pieces.first[piece]
        end = graph.end_of[piece]
        goes_on = np.ones(len(here), bool)
        skill = log.skill_of(choice)
        while goes_on.any():
            now, steps = here[goes_on], step[goes_on]
            readings = known.take(steps)
            if observed is not None:  # the goal is that of the episode, not of the logged call
                there = observed.holds(log.next_obs[steps], observed.of(first[now]))
                readings.events[:, 0] = there
            acting.follow(memory, now, readings, _running(skill[goes_on]))
            elapsed[now] += 1
            history.steps[number, now] += 1
            step += goes_on
            goes_on &= (step <= graph.end_step[end]) & (elapsed[here] < limit)
            goes_on &= ~machine.is_over(acting.state_of(memory, here))
        over = machine.is_over(acting.state_of(memory, here)) | (elapsed[here] >= limit)
        running[here[over | planner.over[end]]] = False
        may[here] = graph.may[end]
        # A call that moved no further than it started away led nowhere.
        begins = before[graph.pieces.first[piece]]
        off = np.maximum(_shift(planner, skill, begins, obs[here]), SLACK)
        moved = _shift(planner, skill, begins, graph.end[end]) > off
        obs[here[moved]] = graph.end[end[moved]]
        for own, start, same in zip(leaves(obs), leaves(first), fixed, strict=True):
            np.copyto(own, start, where=same)
        if not running.any():
            break
    state = acting.state_of(memory, np.arange(n))
    history.last = state[:, 0]
    history.done = machine.has_succeeded(state)
    return history


def _pooled(halves: Sequence[tuple[float, float, float]]) -> tuple[float, float]:
    """Return the bounds of a forecast: the mean of independent chances with their bounds."""
    chance, low, high = np.array(halves).T
    below = np.sqrt(np.square(chance - low).sum()) / len(chance)
    above = np.sqrt(np.square(high - chance).sum()) / len(chance)
    middle = chance.mean()
    return float(max(0.0, middle - below)), float(min(1.0, middle + above))


def _running(skill: Array) -> LastCall:
    """Return last calls of skills (k,) that have not ended, for a plan's selector."""
    n = len(skill)
    return LastCall(skill, np.full(n, CallEnd.RUNNING, np.int8), np.zeros(n, bool))


def _shift(planner: Planner, skill: Array, one: Array, other: Array) -> Array:
    """Return the distances (n,) between observations, as the skills of calls see them."""
    shift = np.zeros(len(skill))
    for i in np.unique(skill):
        mine = skill == i
        features = planner.graph.maps[i]
        shift[mine] = np.linalg.norm(features(one[mine]) - features(other[mine]), axis=1)
    return shift


def _usual_calls(
    planner: Planner, followed: _Followed
) -> tuple[tuple[tuple[str, float], ...], tuple[str, ...]]:
    """Return the most frequent order of skills, with the mean steps of each, and their goals."""
    log = planner.graph.log
    with_goals = np.array([name in log.goals for name in log.skills])
    orders: dict[tuple[int, ...], list[tuple[Array, Array]]] = {}
    shown = followed.done if followed.done.any() else np.ones_like(followed.done)
    for e in np.flatnonzero(shown).tolist():
        skill = followed.skill[:, e]
        called = np.flatnonzero(skill >= 0)
        new = np.diff(skill[called], prepend=-1) != 0
        first = called[new | with_goals[skill[called]]]
        sums = np.add.reduceat(followed.steps[: len(called), e], first)
        orders.setdefault(tuple(skill[first].tolist()), []).append((sums, followed.aim[first, e]))
    order, episodes = max(orders.items(), key=lambda item: len(item[1]))
    steps, aims = (np.array(column) for column in zip(*episodes, strict=True))
    calls = zip(order, steps.mean(0).tolist(), strict=True)
    goals = [planner.shown_goals(i, aims[:, place]) for place, i in enumerate(order)]
    return tuple((log.skills[i], mean) for i, mean in calls), tuple(goals)


def _unknown(planner: Planner) -> str:
    """Return the reason why a log cannot say how likely a plan succeeds."""
    log = planner.graph.log
    if (episodes := len(np.unique(log.episode))) < FEWEST_EPISODES:
        return (
            f"the log has {episodes} episode{'s' * (episodes != 1)}, and goals are judged by other "
            f"episodes than they are chosen by: record at least {FEWEST_EPISODES}"
        )
    if log.began_late.mean() > 0.5:
        return (
            f"{log.began_late.mean():.0%} of the logged calls began too late to run their whole "
            "length before the time limit of their episode: record calls in longer episodes"
        )
    return "the log has no calls near where the plan leads: record more"


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
    if not len(state):
        return "its calls succeed in the log by luck: calls of the same goals mostly fail"
    stuck = machine.state_names[int(np.bincount(state).argmax())]
    return f"most episodes end in the state {stuck!r}"
