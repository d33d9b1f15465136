"""Steps and walks whose numbers are chosen by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from ready_selectors.watching import watched

from skillweave.calls import Predicate
from skillweave.planning import Planner
from skillweave.policies.core import LIMIT
from skillweave.skills import LastCall
from skillweave.types import Array, Step


def step_to(after, before=None, **more) -> Step:
    """A step of n environments to the observations ``after`` (n, D)."""
    after = np.asarray(after, np.float32)
    before = np.zeros_like(after) if before is None else np.asarray(before, np.float32)
    n = len(after)
    no = np.zeros(n, bool)
    values = {
        "action": np.zeros(n, np.int64),
        "reward": np.zeros(n, np.float32),
        "terminated": no,
        "truncated": no,
        "timed_out": no,
        "elapsed": np.ones(n, np.int64),
        "info": {},
    } | more
    return Step(obs=before, next_obs=after, **values)


def column(i: int):
    """A predicate: number ``i`` of the observation is not 0."""

    def holds(obs: Array) -> Array:
        return obs[:, i] != 0

    holds.__name__ = "abcdef"[i]
    return holds


def at(*places: float) -> Predicate:
    """The predicate that the first number is one of these."""
    return Predicate(lambda obs: np.isin(obs[:, 0], places), f"at {places[0]}", "obs")


def assert_not_repeated(planner: Planner, ahead: Callable[[Any], Any]):
    """At 2 is a wall: choices that are ``ahead`` lead nowhere, but are made a few times at most."""
    memory, obs, chosen = planner.start(1), np.float32([[2]]), [True]
    while chosen[-1] and len(chosen) < 7:
        choice, memory = planner.act(memory, obs)
        chosen.append(bool(ahead(choice)[0]))
        before, obs = obs, np.float32([[2 * chosen[-1]]])
        skill = choice["skill"] if choice.dtype.fields else choice
        last = LastCall(skill, np.full(1, LIMIT, np.int8), np.zeros(1, bool))
        for _ in range(3):
            memory = watched(planner, memory, step_to(obs, before), last)
    assert chosen[1]
    assert not chosen[-1]
    assert len(chosen) <= 5
