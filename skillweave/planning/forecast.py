"""Forecasts of plans: episodes that follow a plan along logged calls, before it is played.

A plan chooses the calls that went best, so these calls say too much good of it. Forecasts judge a
plan by calls that it has not seen: episodes of the log are split into folds, the task is solved
without one, and the plan is followed along the calls of that one (cross-fitting).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import gymnasium as gym
import numpy as np

from skillweave.errors import RunError
from skillweave.planning.calls import CallLog
from skillweave.planning.compared import leaves
from skillweave.planning.graph import CallGraph, are_apart, goal_standard
from skillweave.planning.handover import wilson
from skillweave.planning.lacking import names_of, read_log
from skillweave.planning.machine import RewardMachine, predicates_of
from skillweave.planning.neighbors import evenly, nearest
from skillweave.planning.planner import Planner
from skillweave.policies.core import LastCall, Memory, Turn, World
from skillweave.policies.hierarchy import SKILL
from skillweave.policies.parts import GOAL
from skillweave.policies.plan import SOFT, Readings
from skillweave.policies.planned import SLACK, Planned
from skillweave.skills.goal_spaces import choice_space
from skillweave.types import Array

FOLDS = 2
VARIANT = 0
FOLLOWED = 3
EPISODES = 100
"""Episodes that are followed in each fold."""
GOALS = 8
"""The same where each has a goal of its own, which needs a plan of its own."""
MOST_CALLS = 100
"""The most calls of an episode."""
UNLIKELY = 0.2
"""The chance below which the reason is given."""
FAR = 2.0
"""Times the usual distance beyond which a held-out call says nothing."""
OFTEN = 0.2
"""The share of a skill's calls from which on it is named as unsure."""
SHOWN = 6
"""Calls of the intended order that are shown."""
SAMPLED = 500
"""Calls by which it is measured what distance is usual."""
RARE = 0.1
"""The share of episodes below which a step of the plan does not count to the interval."""
OTHER_GOAL = np.float32(1e4)
"""Distance of goals that are compared as different skills are."""


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
        text = " → ".join([*names, "…"] if len(self.calls) > SHOWN else names)
        if self.chance is not None:
            low, high = self.interval
            text += f": a chance of {self.chance:.0%} ({low:.0%} to {high:.0%})"
        text += f", about {self.steps:.0f} steps"
        if self.unsure:
            text += f"; unsure, as the log has few calls near there: {', '.join(self.unsure)}"
        return f"{text}; {self.reason}" if self.reason else text


@dataclass
class _Followed:
    """N episodes that followed a plan, with at most C calls each."""

    skill: Array
    """(C, N) int64; −1: none."""
    steps: Array
    """(C, N) int64."""
    call: Array
    """(C, N) int64, the logged call that was followed."""
    state: Array
    """(C, N) int64, of the task before the call."""
    last: Array
    """(N,) int64, the state of the task at the end."""
    done: Array
    """(N,) bool."""
    known: Array
    """(N,) bool: no call was needed that the log has none near of."""


class HeldOut:
    """Logged calls that are followed where a plan is judged by others.

    Args:
        planner: of the whole log.
        some: (C,) bool, these calls.
    """

    def __init__(self, planner: Planner, some: Array) -> None:
        self.graph = graph = planner.graph
        log, pieces = graph.log, graph.pieces
        self._aims = [goal_standard(log, name) for name in log.skills]
        self._apart = [_has_few_goals(log, choice) for choice in range(log.choices)]
        starts = log.before[pieces.first]
        self._calls: list[tuple[Array, Array, float]] = []
        for choice in range(log.choices):
            rows = np.flatnonzero((pieces.choice == choice) & some[pieces.call])
            goals = log.goals.get(log.skills[log.skill_of(choice)])
            goal = None if goals is None else goals[pieces.call[rows]]
            points = self._at(choice, starts[rows], goal) if len(rows) else np.zeros((0, 1))
            usual = 0.0
            if len(rows):
                of = evenly(np.arange(len(rows)), SAMPLED)
                far = nearest(points, points[of], graph.neighbors + 1, pieces.call[rows])[1][:, -1]
                usual = float(np.median(far))
            self._calls.append((rows, points, max(usual, SOFT) if np.isfinite(usual) else 1.0))

    def _at(self, choice: int, obs: Array, goal: Array | None) -> Array:
        """Return the places of calls by which they are compared, (n, F) float32."""
        skill = self.graph.log.skill_of(choice)
        found = self.graph.maps[skill](obs)
        standard = self._aims[skill]
        if goal is None or standard is None:
            return found
        aims = standard(goal) * (OTHER_GOAL if self._apart[choice] else 1.0)
        return np.concatenate([found, aims], 1, dtype=np.float32)

    def follow(
        self, choice: int, obs: Array, aim: Array, without: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return pieces (n,) of calls near by start and goal; −1: none is; and how far they are."""
        rows, points, usual = self._calls[choice]
        n = len(obs)
        if not len(rows):
            return np.full(n, -1), np.full(n, np.inf)
        log = self.graph.log
        goals = log.goals.get(log.skills[log.skill_of(choice)])
        to = self._at(choice, obs, None if goals is None else goals[aim])
        calls = self.graph.pieces.call[rows]
        near, far = nearest(points, to, FOLLOWED + without.shape[1], calls)
        far[(calls[near][:, :, None] == without[:, None]).any(2)] = np.inf
        order = far.argsort(1, kind="stable")[:, :FOLLOWED]
        near, far = np.take_along_axis(near, order, 1), np.take_along_axis(far, order, 1)
        weights = 1.0 / (far + SOFT)
        weights[~(far <= FAR * np.maximum(far[:, :1], usual))] = 0.0
        drawn = weights.cumsum(1) < rng.random((n, 1)) * weights.sum(1, keepdims=True)
        at = np.minimum(drawn.sum(1), near.shape[1] - 1)
        piece = rows[near[np.arange(n), at]]
        return np.where(far[:, 0] <= FAR * usual, piece, -1), far[:, 0] / usual


def forecast(planner: Planner) -> Forecast:
    """Return how episodes of a plan probably go.

    Episodes of the log are split into folds. For each, the task is solved without its calls, and
    then this plan is followed along its calls: from a logged start, each choice is the plan's, with
    its goal, and one of the nearest held-out calls by start and goal is followed to its end.

    Raises:
        RunError: the log has no start of an episode.
    """
    log, machine = planner.graph.log, planner.machine
    if not (log.order == 0).any():
        raise RunError("the log has no start of an episode, so no plan can be judged by it")
    known = read_log(machine, log)
    rng = np.random.default_rng(0)
    parts = list(_followed(planner, rng))
    done = np.concatenate([part.done for part in parts])
    sure = np.concatenate([part.known for part in parts])
    n = _calls_at_the_scarcest_step(parts)
    chance, reason = None, ""
    low, high = 0.0, 1.0
    if machine.accepting.any():
        chance = float(done.sum() / max(sure.sum(), 1))
        low = float(wilson(done.mean() * n, n)[0])
        high = float(wilson((done | ~sure).mean() * n, n)[1])
        if planner.obstacle:
            chance = 0.0
        if chance < UNLIKELY:
            last = np.concatenate([part.last for part in parts])
            reason = planner.obstacle or _reason(machine, last[~done], log, known)
    shown = [part.done if done.any() else np.ones_like(part.done) for part in parts]
    return Forecast(
        _usual_calls(parts, shown, log.skills),
        chance,
        (low, high),
        float(np.concatenate([p.steps.sum(0)[s] for p, s in zip(parts, shown, strict=True)]).mean()),
        (),
        reason,
    )


def _followed(planner: Planner, rng: np.random.Generator) -> Iterator[_Followed]:
    """Yield the episodes of each half of the log."""
    log = planner.graph.log
    fold = np.unique(log.episode, return_inverse=True)[1].reshape(-1) % FOLDS
    for number in range(FOLDS):
        own = fold == number
        if VARIANT == 2: yield _follow(planner, _acting(planner, ~own), own, rng)
        else: yield _follow(planner, planner.in_place, np.ones_like(own), rng)


def _follow(
    planner: Planner, acting: Planned, own: Array, rng: np.random.Generator
) -> _Followed:
    """Return episodes that follow a plan along calls that it has not seen."""
    graph, machine, observed = planner.graph, planner.machine, planner.observed
    held_out = HeldOut(planner, own)
    log = graph.log
    starts = np.flatnonzero((log.order == 0) & own)
    n = EPISODES if observed is None else GOALS
    first = log.start[starts[np.arange(n) * len(starts) // n]]
    before = log.before
    fixed = [(a == b).all(0) for a, b in zip(*map(leaves, (before, log.next_obs)), strict=True)]
    limit = _limit(planner.log)
    readings = read_log(machine, log)
    obs, memory = first.copy(), acting.start(n)
    elapsed, may = np.zeros(n, np.int64), np.ones((n, log.choices), bool)
    if graph.skills is not None:
        may = graph.skills.hierarchy.may_start(first)
    running, known = np.ones(n, bool), np.ones(n, bool)
    shape = (MOST_CALLS, n)
    history = _Followed(
        *(np.full(shape, -1) for _ in range(4)), np.zeros(n, np.int64), running, known
    )
    history.steps[:] = 0
    for number in range(MOST_CALLS):
        here = np.flatnonzero(running)
        may_here = may[here] | ~may[here].any(1, keepdims=True)
        option, near = acting.decide(memory, here, obs[here], Turn(World(rng), may_here), True)
        choice, each = graph.choice_of[option], np.arange(len(here))
        aim, piece = near.goal[each, option], np.full(len(here), -1)
        judges = np.where(np.isfinite(near.weights[each, option]), graph.pieces.call[near.pieces[each, option]], -1)
        for one in np.unique(choice):
            mine = np.flatnonzero(choice == one)
            without = aim[mine, None]
            if VARIANT == 1 and (aim[mine]>=0).all(): without = np.concatenate([without, judges[mine]], 1)
            piece[mine] = held_out.follow(int(one), obs[here[mine]], aim[mine], without, rng)[0]
        unknown = piece < 0
        known[here[unknown]] = running[here[unknown]] = False
        history.state[number, here] = memory["state"][here]
        history.skill[number, here] = log.skill_of(choice)
        here, piece, choice = here[~unknown], piece[~unknown], choice[~unknown]
        if not len(here):
            break
        history.call[number, here] = graph.pieces.call[piece]
        step, end = graph.pieces.first[piece], graph.end_of[piece]
        last = LastCall(log.skill_of(choice), np.zeros(len(here), np.int8), np.zeros(len(here), bool))
        goes_on = np.ones(len(here), bool)
        while goes_on.any():
            some, steps = here[goes_on], step[goes_on]
            read = readings.take(steps)
            if observed is not None:  # the goal is that of the episode, not of the logged call
                there = observed.holds(log.next_obs[steps], observed.of(first[some]))
                read.events[:, 0] = there
            of = LastCall(*(x[goes_on] for x in (last.skill, last.why, last.succeeded)))
            acting.follow(memory, some, read, of)
            elapsed[some] += 1
            history.steps[number, some] += 1
            step += goes_on
            goes_on &= (step <= graph.end_step[end]) & (elapsed[here] < limit)
            goes_on &= ~machine.is_over(_state(memory, here))
        is_over = machine.is_over(_state(memory, here)) | (elapsed[here] >= limit) | planner.over[end]
        running[here[is_over]] = False
        # An end is one of here where the call moved further than its start is away.
        begins = before[graph.pieces.first[piece]]
        skill = log.skill_of(choice)
        off = np.maximum(_shift(graph, skill, begins, obs[here]), SLACK)
        moved = _shift(graph, skill, begins, graph.end[end]) > off
        may[here] = graph.may[end]
        obs[here[moved]] = graph.end[end[moved]]
        for mine, start, same in zip(leaves(obs), leaves(first), fixed, strict=True):
            np.copyto(mine, start, where=same)
        if not running.any():
            break
    everywhere = np.arange(n)
    history.last = memory["state"]
    history.done = machine.has_succeeded(_state(memory, everywhere))
    history.known = known
    return history


def _has_few_goals(log: CallLog, choice: int) -> bool:
    """Return whether each goal of a choice is as another skill would be."""
    goals, mine = log.goals.get(log.skills[log.skill_of(choice)]), log.choice == choice
    return goals is not None and are_apart(len(np.unique(goals[mine], axis=0)), int(mine.sum()))


def _limit(log: CallLog) -> float:
    """Return the episode's time limit by the log; infinite: it shows none."""
    return float((log.age + log.tau)[log.was_cut].max(initial=0) or np.inf)


def _acting(planner: Planner, some: Array) -> Planned:
    """Return the rule that acts by a plan and some of its calls."""
    return replace(planner.in_place, options=planner.graph.options.of_calls(some))


def _state(memory: Memory, rows: Array) -> Array:
    """Return the task's state in a memory, (k, 1 + H)."""
    return np.concatenate([memory["state"][rows, None], memory["counters"][rows]], 1)


def _shift(graph: CallGraph, skill: Array, one: Array, other: Array) -> Array:
    """Return the distances (n,) between observations, as the skills of calls see them."""
    shift = np.zeros(len(skill))
    for i in np.unique(skill):
        mine, features = skill == i, graph.maps[i]
        shift[mine] = np.linalg.norm(features(one[mine]) - features(other[mine]), axis=1)
    return shift


def _calls_at_the_scarcest_step(parts: Sequence[_Followed]) -> float:
    """Return the held-out calls by which the scarcest step of a plan was judged.

    A step is a skill in a state of the task. A call that many episodes followed counts once, so
    the number is that of equally used calls (Kish 1965).
    """
    episodes = sum(len(part.done) for part in parts)
    uses: dict[tuple[int, int], dict[tuple[int, int], int]] = {}
    for fold, part in enumerate(parts):
        used = np.flatnonzero((part.call >= 0).reshape(-1))
        rows = zip(
            part.state.reshape(-1)[used].tolist(),
            part.skill.reshape(-1)[used].tolist(),
            part.call.reshape(-1)[used].tolist(),
            strict=True,
        )
        for state, skill, call in rows:
            of = uses.setdefault((state, skill), {})
            of[fold, call] = of.get((fold, call), 0) + 1
    counts = [np.array([*of.values()]) for of in uses.values()]
    often = [x for x in counts if x.sum() >= RARE * episodes]
    return min((float(x.sum() ** 2 / np.square(x).sum()) for x in often), default=0.0)


def _usual_calls(
    parts: Sequence[_Followed], shown: Sequence[Array], skills: tuple[str, ...]
) -> tuple[tuple[str, float], ...]:
    """Return the most frequent order of skills, with the mean steps of each."""
    orders: dict[tuple[int, ...], list[Array]] = {}
    for part, some in zip(parts, shown, strict=True):
        for skill, steps in zip(part.skill[:, some].T, part.steps[:, some].T, strict=True):
            called = np.flatnonzero(skill >= 0)
            first = called[np.diff(skill[called], prepend=-1) != 0]
            sums = np.add.reduceat(steps[: len(called)], first)
            orders.setdefault(tuple(skill[first].tolist()), []).append(sums)
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
