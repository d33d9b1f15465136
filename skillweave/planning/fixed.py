"""Whether a task depends on numbers that differ between episodes and never change within one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skillweave.calls.columns import CallColumns
from skillweave.calls.compared import FEWEST, MOST, fixed_places, predict_better
from skillweave.calls.neighbors import evenly
from skillweave.planning.lacking import read_log
from skillweave.planning.machine import RewardMachine
from skillweave.spaces import leaves

READ = 2_000
"""The steps by which it is measured whether a task reads a number."""


def needs_fixed(task: RewardMachine, log: CallColumns) -> bool:
    """Return whether a task reads such a number, or what such a number helps to predict.

    That is a reward, ``info``, or an end of the episode.

    Raises:
        RunError: see ``read_log``.
    """
    fixed = fixed_places(log)
    return bool(fixed) and (_reads_fixed(task, log) or _pays_by(task, log, fixed))


def _reads_fixed(task: RewardMachine, log: CallColumns) -> bool:
    """Return whether a task is another one with the fixed numbers of another episode.

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


def _pays_by(task: RewardMachine, log: CallColumns, fixed: list[int]) -> bool:
    """Return whether the ``fixed`` numbers help to predict what a task reads of steps.

    The environment's reward, ``info`` and ends may follow from numbers that the task does not read.

    Raises:
        RunError: see ``read_log``.
    """
    rest = [place for place in np.flatnonzero(log.varies).tolist() if place not in fixed]
    if not rest or not (task.rewards or any(event.reads != "obs" for event in task.events)):
        return False
    known = read_log(task, log)
    read = np.concatenate([known.events, known.values], 1)
    odd = (read != np.median(read, 0)).any(1)  # seldom steps, as those that pay, count as much
    rows = np.concatenate([evenly(np.flatnonzero(some), MOST // 2) for some in (odd, ~odd)])
    at = log.flat(log.next_obs)[rows]
    return len(rows) > FEWEST and predict_better(at[:, rest], at[:, [*rest, *fixed]], read[rows])
