"""Learners that choose by what they see: no network, and nothing to remember."""

from __future__ import annotations

import itertools
import os
import signal
import zlib
from typing import Any

import numpy as np
from reference_calls import EPISODE, Walk

from skillweave.collecting.acting import Acted, Request
from skillweave.seeding import Seeds
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

    def to_env(self, action: Array) -> Array:
        return action

    def all(self, obs: Array, mask: Array | None, memory: Any) -> Acted:
        return self.some(np.arange(self.num_envs), obs, mask, memory)

    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Any) -> Acted:
        chosen = []
        for row in rows:
            rng = np.random.default_rng(zlib.crc32(obs[row].tobytes()))
            allowed = np.ones(self.actions, bool) if mask is None else mask[row]
            chosen.append(rng.choice(np.flatnonzero(allowed)))
        action = np.array(chosen, np.int64)
        return Acted(action, action[:, None].astype(np.float32), None)


def requests(rows: int, gamma: float = 0.97) -> Any:
    """Requests for ``rows`` rows each, one after another."""
    for i in itertools.count():
        yield Request(rows, (), np.array([gamma]), Seeds(0) / i)


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
        if self.fuse is not None and self.fuse.exists() and self.t == 2:
            self.fuse.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)
