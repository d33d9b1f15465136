"""Logs of calls that are written by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.calls import CallLog
from skillweave.policies.core import CallEnd

WHY = {"own": CallEnd.OWN, "limit": CallEnd.LIMIT, "end": CallEnd.EPISODE, "cut": CallEnd.EPISODE}


def log_of(
    skills: Sequence[str], episodes: Sequence[Any], size: int = 1, lengths: Sequence[int] = (),
    rewards = None, limits: Sequence[int | None] = (),
) -> CallLog:  # fmt: skip
    """A log of episodes (first observation, [(choice, [observations inside], won, why), …]).

    ``why`` is own, limit, end (the episode terminated) or cut (its time limit). An observation is a
    number, or several.
    """
    rows, inside, choices = [], [], len(skills) * max(1, len(lengths))
    for e, (here, calls) in enumerate(episodes):
        age = 0
        for order, (choice, steps, won, why) in enumerate(calls):
            rows.append((here, choice, won, why, WHY[why], e, order, age, len(steps)))
            inside += steps
            here, age = steps[-1], age + len(steps)
    start, choice, won, why, end, episode, order, age, tau = map(np.array, zip(*rows, strict=True))
    return CallLog(
        tuple(skills),
        tuple(lengths),
        ("",) * len(skills),
        (None,) * len(skills),
        (False,) * len(skills),
        (True,) * len(skills),
        gym.spaces.Box(-np.inf, np.inf, (size,), np.float32),
        gym.spaces.Discrete(2),
        start=start.astype(np.float32).reshape(-1, size),
        choice=choice,
        end_reason=end.astype(np.int8),
        succeeded=won,
        terminated=why == "end",
        truncated=why == "cut",
        episode=episode,
        seed=episode,
        order=order,
        age=age,
        may_follow=np.ones((len(rows), choices), bool),
        offset=np.concatenate([[0], np.cumsum(tau)]),
        next_obs=np.array(inside, np.float32).reshape(-1, size),
        action=np.zeros(len(inside), np.int64),
        reward=np.zeros(len(inside), np.float32) if rewards is None else np.float32(rewards),
        limits=tuple(limits),
    )


def jumps(goals, starts=range(11)) -> CallLog:
    """A log of one skill with goals: from each start it goes three steps towards each goal."""
    calls, given = [], []
    for start in starts:
        for goal in goals:
            inside = np.clip(np.arange(1, 4) * np.sign(goal - start), *sorted((0, goal - start)))
            calls.append((start, [(0, (start + inside).tolist(), True, "limit")]))
            given.append([goal])
    log = log_of(["go"], calls)
    log.goals["go"] = np.array(given, np.float64)
    return log
