"""Tasks that a log of calls does not suffice for, in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from skillweave.calls.columns import CallColumns
from skillweave.calls.neighbors import Standard
from skillweave.calls.predicates import Predicate, reads_of
from skillweave.errors import RunError, SkillweaveError
from skillweave.planning.machine import Arrow, RewardMachine, predicates_of
from skillweave.policies.core import Array, observed
from skillweave.policies.plan import Readings

TRIES = 20_000
"""Observations that are made up, to find one in which a predicate holds."""
MOSTLY = 0.5
"""The share of starts from which on a task is said to be done there already."""
NEARLY_ALWAYS = 0.99
"""The share of steps from which on an event is said to hold always."""
MOST_PLACES = 1_000_000
"""The most pairs of a task's state and what holds, that are searched for a way."""


def read_log(task: RewardMachine, log: CallColumns) -> Readings:
    """Evaluate a task's events and rewards on all steps of a log.

    Raises:
        RunError: the task reads a key of ``info`` that was not recorded.
        SkillError: an event or a reward failed, or returned another shape or type.
    """
    with reads_of(log):
        return task.acts.read(log.as_steps())


def check_possible(task: RewardMachine, readings: Readings, log: CallColumns) -> None:
    """Raise a RunError where no logged step lets the task go on, though it is not over.

    The error names the predicates that never hold, and the skill that comes nearest to one.
    """
    happens = readings.events.max(0, initial=False)
    reached = {task.acts.first}
    queue = [task.acts.first]
    missing: dict[str, Predicate] = {}
    pays = bool(task.acts.each.any() or task.acts.each_by.any())
    while queue:
        state = queue.pop()
        for arrow in task.leaving[state]:
            absent = [p for p in predicates_of(arrow) if not happens[task.number(p)]]
            if absent and not task.failing[arrow.target]:
                missing |= {p.name: p for p in absent}
            if not absent:
                pays |= callable(arrow.reward) or arrow.reward > 0
                if arrow.target not in reached:
                    reached.add(arrow.target)
                    queue.append(arrow.target)
    accepted = not task.accepting.any() or bool(task.accepting[list(reached)].any())
    if (accepted and pays) or not missing:
        return
    raise RunError(_sentence(list(missing.values()), log))


def obstacle(task: RewardMachine, log: CallColumns) -> str:
    """Return why no order of logged steps does a task, in a sentence; empty: one does.

    Steps in which the same events hold count as the same, and counters are one step short, so an
    order that the log allows is never missed.
    """
    events = read_log(task, log)
    _, first, of = np.unique(events.events, axis=0, return_index=True, return_inverse=True)
    count = len(first)
    of = of.reshape(-1)
    joined = np.flatnonzero(log.followed_by >= 0)
    if not task.accepting.any() or not len(joined) or count * len(task.accepting) > MOST_PLACES:
        return ""
    # What may follow: from pattern to pattern; the last row is the start of an episode.
    follows = np.zeros((count + 1, count), bool)
    inside = np.flatnonzero(np.diff(log.owner) == 0)
    follows[of[inside], of[inside + 1]] = True
    follows[of[log.offset[joined + 1] - 1], of[log.offset[log.followed_by[joined]]]] = True
    follows[count, of[log.offset[:-1][log.order == 0]]] = True
    reached: Array = np.zeros((len(task.accepting), count + 1), bool)
    new = reached.copy()
    new[task.acts.first, count] = True
    while new.any():
        reached |= new
        place, at = np.nonzero(new & ~(task.accepting | task.failing)[:, None])
        rows, to = np.nonzero(follows[at])
        state = np.column_stack([place, task.counter_steps[place] - 1])[rows]
        new = np.zeros_like(reached)
        new[task.acts.advance(state, events.take(first[to]))[0][:, 0], to] = True
        new &= ~reached
    states: Array = np.asarray(reached.any(1))
    if (states & task.accepting).any():
        return ""
    arrows = [a for a in task.arrows if states[a.origin]]
    wanted = names_of(a for a in arrows if not (states | task.failing)[a.target])
    text = f"no plan does this task by the log: {wanted} never holds"
    if before := names_of(a for a in arrows if states[a.target] and not task.failing[a.target]):
        text += f" after {before}"
    if avoided := names_of(a for a in arrows if task.failing[a.target]):
        text += f", unless {avoided} holds first, which is avoided"
    return text


def asks_nothing(task: RewardMachine, log: CallColumns) -> str:
    """Return a sentence on words of a task that hold before anything is done; empty: none does.

    A task asks for nothing if most logged episodes do it in the fewest steps in which it can be
    done, whatever skill acts. An event that holds in nearly all logged steps asks for nothing
    either. One that must hold for several steps, and one that is avoided, are no such events.
    """
    events = read_log(task, log).events
    step = log.offset[:-1][log.order == 0]
    fewest = _fewest_steps(task)
    if not len(step) or not fewest:
        return ""
    state = task.start(len(step))
    going = np.ones(len(step), bool)
    last = log.offset[1:] - 1
    held: dict[str, float] = {}
    for _ in range(fewest):
        for arrow in {a for q in np.unique(state[going, 0]) for a in task.leaving[int(q)]}:
            mine = going & (state[:, 0] == arrow.origin) & ~task.failing[arrow.target]
            for predicate in predicates_of(arrow) if mine.any() else ():
                share = float(events[step[mine], task.number(predicate)].mean())
                if share > MOSTLY:
                    held.setdefault(predicate.name, share)
        state[going] = task.acts.advance(
            state[going],
            Readings(events[step[going]], np.zeros((int(going.sum()), len(task.acts.rewards) + 1))),
        )[0]
        owner = log.owner[step]
        follows = log.followed_by[owner]
        ends = step == last[owner]
        going &= ~(ends & (follows < 0))
        step = np.where(
            ends, log.offset[np.maximum(follows, 0)], np.minimum(step + 1, log.steps - 1)
        )
    done = float(task.has_succeeded(state).mean())
    if done > MOSTLY and held:
        return (
            f"{_joined(held)} hold{'s' * (len(held) == 1)} already in {done:.0%} of the logged "
            "starts, so the mission asks for nothing there: it is done whatever a skill does"
        )
    idle = [
        predicate.name
        for predicate in {p.name: p for a in task.arrows if not task.failing[a.target]
                          for p in _momentary(a)}.values()
        if events[:, task.number(predicate)].mean() > NEARLY_ALWAYS
    ]  # fmt: skip
    if not idle or not task.accepting.any():
        return ""
    return (
        f"{_joined(idle)} hold{'s' * (len(idle) == 1)} in nearly all logged steps, so the mission "
        "asks for nothing there"
    )


def _momentary(arrow: Arrow) -> list[Predicate]:
    """Return an arrow's predicates that need not hold for several steps."""
    return [event for event in arrow.events if isinstance(event, Predicate)]


def _fewest_steps(task: RewardMachine) -> int:
    """Return the fewest steps in which a task can be done, one for each transition; 0: never."""
    steps = 0
    reached = {task.acts.first}
    while not task.accepting[list(reached)].any():
        further = {a.target for q in reached for a in task.leaving[q] if not task.failing[a.target]}
        if further <= reached:
            return 0
        reached |= further
        steps += 1
    return steps


def _joined(names: Iterable[str]) -> str:
    return " and ".join(map(repr, names))


def names_of(arrows: Iterable[Arrow]) -> str:
    """Return the names of arrows' events, each once."""
    names = (predicate.name for arrow in arrows for predicate in predicates_of(arrow))
    return " or ".join(map(repr, dict.fromkeys(names)))


def _sentence(missing: Sequence[Predicate], log: CallColumns) -> str:
    """Return a sentence on predicates that hold in no step of a log."""
    names = " and ".join(repr(p.name) for p in missing[:3])
    verb = "holds" if len(missing) == 1 else "hold"
    text = f"{names} never {verb} in the {log.steps:,} steps of the log, so no plan leads there"
    for predicate in missing:
        if near := _nearest(predicate, log):
            return f"{text}; {near}. Record more steps, or add a skill that leads there"
    return f"{text}; check the predicate, record more steps, or add a skill that leads there"


def _nearest(predicate: Predicate, log: CallColumns) -> str:
    """Return a clause on the skill that comes nearest to where a predicate holds; "": unknown."""
    obs = log.next_obs
    if predicate.reads != "obs" or obs.ndim != 2 or obs.dtype.kind != "f":
        return ""
    wanted = _example(predicate, obs)
    if wanted is None:
        return ""
    standard = Standard(obs)
    wanted = standard(wanted)
    step = 0
    least = np.inf
    for first in range(0, len(obs), 4_096):  # so that no large array is made
        part = standard(obs[first : first + 4_096, None]) - wanted
        far = np.square(part).mean(2).min(1)
        if far.min() < least:
            least = float(far.min())
            step = first + int(far.argmin())
    name = log.skills[int(log.skill[log.owner[step]])]
    return f"{name!r} comes nearest, in observation {observed(obs[step])}"


def _example(predicate: Predicate, obs: Array) -> Array | None:
    """Return observations (k, D) in which a predicate holds, made up at random; None: in none."""
    rng = np.random.default_rng(0)
    low, high = obs.min(0), obs.max(0)
    span = np.maximum(high - low, 1e-3)
    made = obs[rng.integers(len(obs), size=TRIES)].astype(np.float64)
    free = rng.uniform(low - span, high + span, made.shape)
    # In half of them all numbers are free, in the others one to three.
    share = np.where(np.arange(TRIES) % 2, 1.0, rng.integers(1, 4, TRIES) / obs.shape[1])
    made = np.where(rng.random(made.shape) < share[:, None], free, made).astype(obs.dtype)
    try:
        holds = predicate.at(made)
    except SkillweaveError:
        return None
    return made[holds][:64] if holds.any() else None
