"""The numbers of observations by which calls are compared, where the user names none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave._internal.messages import short, suggest
from skillweave.errors import DeclarationError
from skillweave.planning.columns import CallColumns
from skillweave.planning.lacking import read_log
from skillweave.planning.machine import RewardMachine
from skillweave.planning.neighbors import FeatureMap, Standard, evenly, nearest
from skillweave.policies.core import Array
from skillweave.spaces import leaves, obs_codec

MOST_STEPS = 0.5
"""The share of steps in which a number has to change to be compared, if a skill does not see it."""
FEWEST = 30
"""Calls of a skill from which on it is measured whether a number says where they end."""
MOST = 2_000
"""The most calls that this is measured by."""
NEIGHBORS = 5
BETTER = 0.95
"""The error of predicted ends, relative to that without some numbers, below which they help."""
READ = 2_000
"""The steps by which it is measured whether a task reads a number."""

Places = Sequence[int] | None


def compared_places(log: CallColumns, task: RewardMachine | None = None) -> tuple[Places, ...]:
    """Return the places by which calls of each skill are compared; None: all.

    They are the places that the skill sees, and those that change in most steps, as a position
    does: these say where a call ends though the skill does not see them, behind which wall, for
    example. A number that differs between episodes and never changes within one, as the place of a
    goal, only divides the log: it counts where it helps to predict where the skill's calls end, or
    where the task reads it, or reads a reward, ``info`` or an end that it helps to predict.

    Args:
        log: the calls.
        task: the planned task; None: the numbers are for any.
    """
    space = log.observation_space
    codec = obs_codec(space)
    if codec.images and all(seen is None for seen in log.sees):
        return tuple(log.sees)
    before, after = log.flat(log.before), log.flat(log.next_obs)
    changes = (before != after).mean(0)
    varies = Standard(before).varies
    fixed = np.flatnonzero((changes == 0) & varies).tolist()
    moves = np.flatnonzero(changes > MOST_STEPS).tolist()
    if fixed and task is not None:
        free = [place for place in np.flatnonzero(varies).tolist() if place not in fixed]
        if _reads_fixed(task, log) or _pays_by(task, log, after, free, fixed):
            fixed = []
    start = before[log.offset[:-1]]
    end = after[log.offset[1:] - 1]
    places: list[Places] = []
    for skill, seen in enumerate(log.sees):
        if seen is None and codec.images:
            places.append(None)
            continue
        whole = range(codec.size) if seen is None else sorted({*seen, *moves})
        doubtful = [place for place in whole if place in fixed]
        rest = [place for place in whole if place not in fixed and varies[place]]
        if doubtful and rest and not _help(log, skill, start, end, rest, doubtful):
            places.append([place for place in whole if place not in fixed])
        else:
            places.append(seen if seen is None else whole)
    return tuple(places)


def feature_maps(
    log: CallColumns,
    features: Any,
    known: Array,
    task: RewardMachine | None = None,
    skills: Sequence[int] | None = None,
) -> dict[int, FeatureMap]:
    """Return the features by which a log's calls are compared, by their skills' places.

    Args:
        log: the calls.
        features: for all skills, or by skill; None: the log's own, else the ``compared_places``.
        known: logged observations.
        task: see ``compared_places``.
        skills: the places of those that are compared; None: all.
    """
    places = compared_places(log, task)
    names = log.skills
    features = log.features if features is None else features
    by_skill = features if isinstance(features, Mapping) else dict.fromkeys(names, features)
    for name in by_skill:
        if name not in names:
            raise DeclarationError(
                f"features= names {short(name)}, which is no skill of the log{suggest(name, names)}"
            )
    return {
        i: FeatureMap(
            log.observation_space,
            places[i] if by_skill.get(names[i]) is None else by_skill[names[i]],
            known,
            f"skill {names[i]!r}",
        )
        for i in (range(len(names)) if skills is None else skills)
    }


def _help(
    log: CallColumns, skill: int, start: Array, end: Array, rest: list[int], more: list[int]
) -> bool:
    """Return whether ``more`` numbers beside ``rest`` help to predict where a skill's calls end."""
    rows = np.flatnonzero((log.skill == skill) & ~log.began_late)  # a time limit cuts anywhere
    if len(rows) < FEWEST:
        return True
    rows = evenly(rows, MOST)
    moved = end[rows][:, rest].astype(np.float64) - start[rows][:, rest]
    goal = log.goals.get(log.skills[skill])
    own = np.zeros((len(rows), 0)) if goal is None else goal[rows]

    def points(places: list[int]) -> Array:
        return np.concatenate([start[rows][:, places], own], 1)

    return _predict(points(rest), points([*rest, *more]), moved)


def _pays_by(
    task: RewardMachine, log: CallColumns, after: Array, rest: list[int], more: list[int]
) -> bool:
    """Return whether ``more`` numbers beside ``rest`` help to predict what a task reads of steps.

    The environment's reward, ``info`` and ends may follow from numbers that the task does not read.

    Raises:
        RunError: see ``read_log``.
    """
    if not rest or not (task.rewards or any(event.reads != "obs" for event in task.events)):
        return False
    known = read_log(task, log)
    read = np.concatenate([known.events, known.values], 1)
    odd = (read != np.median(read, 0)).any(1)  # seldom steps, as those that pay, count as much
    rows = np.concatenate([evenly(np.flatnonzero(some), MOST // 2) for some in (odd, ~odd)])
    at = after[rows]
    return len(rows) > FEWEST and _predict(at[:, rest], at[:, [*rest, *more]], read[rows])


def _predict(few: Array, many: Array, values: Array) -> bool:
    """Return whether points ``many`` (n, F) predict values (n, D) better than ``few``."""
    wanted = Standard(values)(values)

    def error(seen: Array) -> float:
        """Return the squared error of predicting a point by its nearest neighbors."""
        points = Standard(seen)(seen).astype(np.float32)
        near, _ = nearest(points, points, NEIGHBORS + 1, np.arange(len(points)))
        others = near != np.arange(len(points))[:, None]
        mean = (wanted[near] * others[..., None]).sum(1) / others.sum(1)[:, None]
        return float(np.square(mean - wanted).mean())

    return error(many) < BETTER * error(few)


def _reads_fixed(task: RewardMachine, log: CallColumns) -> bool:
    """Return whether a task is another one with another episode's fixed numbers.

    Raises:
        RunError: see ``read_log``.
    """
    rng = np.random.default_rng(0)
    calls = rng.permutation(len(log))
    few = log.take(calls[: np.searchsorted(np.cumsum(log.tau[calls]), READ) + 1])
    start, inside = few.start.copy(), few.next_obs.copy()
    other = few.next_obs[rng.permutation(few.steps)]
    for own, new in ((start, other[few.offset[:-1]]), (inside, other)):
        arrays = (log.before, log.next_obs, own, new)
        for first, then, mine, others in zip(*map(leaves, arrays), strict=True):
            np.copyto(mine, others, where=(first == then).all(0))
    changed = read_log(task, replace(few, start=start, next_obs=inside))
    known = read_log(task, few)
    return not (
        np.array_equal(known.events, changed.events)
        and np.array_equal(known.values, changed.values)
    )
