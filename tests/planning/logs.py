"""Logs of calls that are written by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.planning import CallLog
from skillweave.policies.core import CallEnd

WHY = {"own": CallEnd.OWN, "limit": CallEnd.LIMIT, "end": CallEnd.EPISODE, "cut": CallEnd.EPISODE}


def log_of(
    skills: Sequence[str], episodes: Sequence[Any], size: int = 1, lengths: Sequence[int] = (),
    rewards: Any = None,
) -> CallLog:  # fmt: skip
    """A log of episodes (first observation, [(choice, [observations inside], won, why), …]).

    ``why`` is own, limit, end (the episode terminated) or cut (its time limit). An observation is a
    number, or several.
    """
    columns: dict[str, list[Any]] = {
        name: [] for name in ("start", "choice", "why", "won", "episode", "order", "age", "inside")
    }
    offset, choices = [0], len(skills) * max(1, len(lengths))
    for e, (first, calls) in enumerate(episodes):
        here, age = first, 0
        for order, (choice, inside, won, why) in enumerate(calls):
            for name, value in (
                ("start", here), ("choice", choice), ("why", why), ("won", won), ("episode", e),
                ("order", order), ("age", age),
            ):  # fmt: skip
                columns[name].append(value)
            columns["inside"] += inside
            offset.append(offset[-1] + len(inside))
            here, age = inside[-1], age + len(inside)
    calls, steps = len(columns["choice"]), offset[-1]
    why = np.array(columns["why"])
    return CallLog(
        tuple(skills),
        tuple(lengths),
        ("",) * len(skills),
        (None,) * len(skills),
        (False,) * len(skills),
        (True,) * len(skills),
        gym.spaces.Box(-np.inf, np.inf, (size,), np.float32),
        gym.spaces.Discrete(2),
        start=np.array(columns["start"], np.float32).reshape(calls, size),
        choice=np.array(columns["choice"], np.int64),
        end_reason=np.array([WHY[w] for w in columns["why"]], np.int8),
        succeeded=np.array(columns["won"], bool),
        terminated=why == "end",
        truncated=why == "cut",
        episode=np.array(columns["episode"], np.int64),
        seed=np.array(columns["episode"], np.int64),
        order=np.array(columns["order"], np.int64),
        age=np.array(columns["age"], np.int64),
        may_follow=np.ones((calls, choices), bool),
        offset=np.array(offset, np.int64),
        next_obs=np.array(columns["inside"], np.float32).reshape(steps, size),
        action=np.zeros(steps, np.int64),
        reward=np.zeros(steps, np.float32) if rewards is None else np.float32(rewards),
    )
