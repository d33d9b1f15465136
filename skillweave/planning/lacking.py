"""Tasks that a log of calls does not suffice for, in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from skillweave.errors import RunError, SkillError, SkillweaveError
from skillweave.planning.columns import CallColumns
from skillweave.planning.machine import Arrow, RewardMachine, predicates_of
from skillweave.planning.neighbors import Standard
from skillweave.planning.predicates import Predicate
from skillweave.policies.core import observed
from skillweave.policies.plan import Readings
from skillweave.types import Array

TRIES = 20_000
"""Observations that are made up, to find one in which a predicate holds."""
MOST_PLACES = 1_000_000
"""The most pairs of a task's state and what holds, that are searched for a way."""


def read_log(task: RewardMachine, log: CallColumns) -> Readings:
    """Evaluate a task's events and rewards on all steps of a log.

    Raises:
        RunError: the task reads a key of ``info`` that was not recorded.
        SkillError: an event or a reward failed, or returned another shape or type.
    """
    try:
        return task.acts.read(log.as_steps())
    except SkillError as error:
        cause = error.__cause__
        key = cause.args[0] if isinstance(cause, KeyError) and cause.args else None
        if not isinstance(key, str) or key in log.info:
            raise
        raise RunError(
            f"the task reads info[{key!r}], which the log does not have; record it: "
            f"record_calls(..., info=[{key!r}])"
        ) from error


def check_possible(task: RewardMachine, readings: Readings, log: CallColumns) -> None:
    """Raise a RunError where no logged step lets the task go on, though it is not over.

    The error names the predicates that never hold, and the skill that comes nearest to one.
    """
    happens = readings.events.max(0, initial=False)
    reached, queue = {task.acts.first}, [task.acts.first]
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
    count, of = len(first), of.reshape(-1)
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


def names_of(arrows: Iterable[Arrow]) -> str:
    """Return the names of arrows' events, each once."""
    names = (predicate.name for arrow in arrows for predicate in predicates_of(arrow))
    return " or ".join(map(repr, dict.fromkeys(names)))


def _sentence(missing: Sequence[Predicate], log: CallColumns) -> str:
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
    step, least = 0, np.inf
    for first in range(0, len(obs), 4_096):  # so that no large array is made
        part = standard(obs[first : first + 4_096, None]) - wanted
        far = np.square(part).mean(2).min(1)
        if far.min() < least:
            least, step = float(far.min()), first + int(far.argmin())
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
