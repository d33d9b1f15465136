"""Learners that choose by what they see: no network, and nothing to remember."""

from __future__ import annotations

import itertools
import os
import signal
import zlib
from contextlib import suppress
from typing import Any

import numpy as np
from reference_calls import EPISODE, Counter, Left, Right, Walk, Zigzag
from toys import alone_in, calling_in, skills_of

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import Batch
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.acting import Acted, Request
from skillweave.experience.collector import Collected, Collector
from skillweave.types import Array


class Choices:
    """Chooses among what is allowed, as a function of the observation alone.

    It stands where ``Acting`` does.
    """

    memory_size = 0
    members = 1

    def __init__(self, num_envs: int, actions: int) -> None:
        self.each = self.num_envs = num_envs
        self.actions = actions

    def begin(self, request: Request, every_step: bool = True) -> None:
        self.request = request

    def widened(self, mask):
        return mask

    def to_env(self, action: Array) -> Array:
        return action

    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Any) -> Acted:
        chosen = []
        for row in range(len(rows)):
            rng = np.random.default_rng(zlib.crc32(obs[row].tobytes()))
            allowed = np.ones(self.actions, bool) if mask is None else mask[row]
            chosen.append(rng.choice(np.flatnonzero(allowed)))
        action = np.array(chosen, np.int64)
        return Acted(action, action[:, None].astype(np.float32), None)


class Given(Choices):
    """Does what it was told last."""

    then: Array  # (N, …), as the environments take it

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, 0)
        self.asked = 0

    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Any) -> Acted:
        return Acted(np.asarray(self.then)[rows], None, None)


class Counts(Choices):
    """Remembers how often it acted since it began; ``head`` says what it remembered before."""

    memory_size = 1

    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Any) -> Acted:
        before = memory.copy()
        return Acted(super().some(rows, obs, mask, None).action, before, before + 1)


def step(collector: Any, action: Any) -> Collected:
    """One row, in which ``Given`` does ``action`` (N, …)."""
    acting: Given = collector.acting
    acting.then, acting.asked = np.asarray(action), acting.asked + 1
    request = Request(1, (), np.array([0.97]), Seeds(0) / acting.asked)
    found: Collected = collector.collect(request)
    return found


def valid_rows(experience: Batch, column: int) -> Array:
    """Which rows of a column count, in order."""
    return np.flatnonzero(experience.valid_rows[:, column])


def requests(rows: int, gamma: float | Array = 0.97) -> Any:
    """Requests for ``rows`` rows each, one after another; γ of each member."""
    for i in itertools.count():
        yield Request(rows, (), np.atleast_1d(gamma), Seeds(0) / i)


class Again(Walk):
    """A walk whose observations do not tell how many episodes there were before."""

    def _obs(self) -> Array:
        obs = super()._obs()
        obs[EPISODE] = 0
        return obs


class Mortal(Again):
    """Its process ends itself at the step and episode that a file names, once."""

    fuse: Any = None  # a file with "tag", removed when it has burnt

    def step(self, action: int) -> Any:
        if self.fuse is not None and self.t == 2:
            with suppress(FileNotFoundError):  # it burnt already, perhaps in another process now
                self.fuse.unlink()
                os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


def deciding(env: Any = Again) -> Any:
    """Makes collectors of a selector of four skills."""

    def make(num_envs: int, first: int) -> Collector:
        engine = make_engine(EnvSpec(env, engine="sync"), num_envs, first=first)
        skills = skills_of(Left, Right, Zigzag, Counter, call_steps=5)
        return calling_in(engine, Choices(num_envs, 4), skills)

    return make


def stepping(env: Any = Again) -> Any:
    """Makes collectors of an agent."""

    def make(num_envs: int, first: int) -> Collector:
        engine = make_engine(EnvSpec(env, engine="sync"), num_envs, first=first)
        return alone_in(engine, Choices(num_envs, 3))

    return make


def equal(one: Any, two: Any) -> None:
    """Both collected the same."""
    for name in (
        "obs", "action", "reward", "steps", "terminated", "truncated", "next_obs", "valid",
    ):  # fmt: skip
        np.testing.assert_array_equal(one.batches[""].get(name), two.batches[""].get(name))
    assert one.steps == two.steps
    np.testing.assert_array_equal(one.episodes, two.episodes)
