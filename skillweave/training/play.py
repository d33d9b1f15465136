"""Playing whole episodes: the one loop of evaluation, periodic evaluation and videos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from skillweave.envs.engine import Engine
from skillweave.envs.infos import allowed_rows
from skillweave.skills.outputs import blame
from skillweave.types import Array, Memory, Policy, Step


@dataclass(slots=True)
class Played:
    """One step in each environment that acts; arrays have a row for each of these."""

    rows: Array  # (k,) int64, the environments
    episode: Array  # (k,) int64, the episode that each of them plays; −1: one that does not count
    step: Step  # ``elapsed`` counts the episode's environment steps
    reward: Array  # (k,) undiscounted; of a call the sum over its steps
    lasted: Array  # (k,) int64, environment steps that the action lasted
    cut: Array  # (k,) bool: nothing had ended the episode when it became too long
    acting: Array | None = None  # (k,) int64, the skill that acted; None: no skills below
    begun: Array | None = None  # (k,) bool: a call of that skill began
    elapsed: Array | None = None  # (k,) int64, steps of its call so far; None: not told
    why: Array | None = None  # (k,) int8, why its call ended, ``CallEnd``; None: not known
    chosen: Memory | None = None  # what the policy remembered when it had acted
    after: Memory | None = None  # the same after the step

    @property
    def over(self) -> Array:
        """(k,) bool: the episode has ended, or was cut."""
        over: Array = self.step.terminated | self.step.truncated | self.cut
        return over


class Episodes(Protocol):
    """Environments and the episodes that are to be played in them."""

    num_envs: int
    rows: Array
    """(k,) environments that act; none: all episodes are over."""
    obs: Array
    """(N, *obs_shape), what to act on next."""

    def mask(self) -> Array | None:
        """(k, A) bool, the actions allowed now, or None."""
        ...

    def step(self, action: Array) -> Played:
        """Act in ``rows``."""
        ...

    def go_on(self, played: Played) -> Array:
        """Begin new episodes where some are over and more are left; (m,) these environments."""
        ...


def play(
    policy: Policy,
    episodes: Episodes,
    *,
    deterministic: bool = True,
    rng: np.random.Generator | None = None,
    before_step: Callable[[Memory], None] | None = None,
) -> Iterator[Played]:
    """Play all episodes, a step at a time.

    Args:
        deterministic: act greedily, else sample with ``rng``.
        before_step: is shown the policy's memory after it has chosen an action, before the
            environments act.
    """
    n = episodes.num_envs
    memory = policy.start(n)
    while len(rows := episodes.rows):
        own = {k: v[rows] for k, v in memory.items()}
        obs, mask = episodes.obs[rows], episodes.mask()
        try:
            action, own = policy.act(own, obs, mask, deterministic=deterministic, rng=rng)
        except (Exception, SystemExit) as error:
            blame(error, "the policy's act()")
        if before_step is not None:
            before_step(own)
        acting = policy.acting(own)
        begun = own["elapsed"] == 0 if "elapsed" in own else np.zeros(len(rows), bool)
        played = episodes.step(action)
        played.acting, played.begun, played.chosen = acting, begun, own
        after = policy.observe(own, played.step)
        played.elapsed, played.why = after.get("elapsed"), after.get("end")
        played.after = after
        for k, v in after.items():
            memory[k][rows] = v
        yield played
        fresh = episodes.go_on(played)
        if len(fresh):
            for k, v in policy.start(n).items():
                memory[k][fresh] = v[fresh]


class SeededEpisodes:
    """Whole episodes in an engine.

    Args:
        seeds: one of each episode; or one for all: each environment plays one episode then, and all
            begin at once.
        max_steps: an episode that nothing has ended by then is cut.
    """

    def __init__(self, engine: Engine, seeds: Sequence[int] | int, max_steps: int) -> None:
        self.engine, self.num_envs = engine, engine.num_envs
        self._seeds, self._max_steps = [] if isinstance(seeds, int) else seeds, max_steps
        self._episode = np.arange(self.num_envs)
        self._elapsed = np.zeros(self.num_envs, np.int64)
        if isinstance(seeds, int):
            self.rows, self._upcoming = np.arange(self.num_envs), 0
            first = engine.reset(seeds)
        else:
            self.rows = np.arange(min(self.num_envs, len(seeds)))
            self._upcoming = len(self.rows)
            first = engine.reset_some(self.rows, list(seeds[: self._upcoming]))
        self.obs = np.array(first)

    def mask(self) -> Array | None:
        """(k, A) bool, the actions allowed now, or None."""
        return allowed_rows(self.engine.mask(), self.rows)

    def step(self, action: Array) -> Played:
        """Act in ``rows``."""
        rows = self.rows
        obs = self.obs[rows]
        raw = self.engine.step(action, rows)
        self._elapsed[rows] += 1
        self.obs[rows] = raw.next_obs
        elapsed, no = self._elapsed[rows], np.zeros(len(rows), bool)
        step = Step(
            obs, action, raw.next_obs, raw.reward, raw.terminated, raw.truncated, no, elapsed,
            raw.info,
        )  # fmt: skip
        cut = ~(raw.terminated | raw.truncated) & (elapsed >= self._max_steps)
        one = np.ones(len(rows), np.int64)
        return Played(rows, self._episode[rows], step, raw.reward, one, cut)

    def go_on(self, played: Played) -> Array:
        """Begin the episodes that are left, in order, where others are over."""
        ended = played.rows[played.over]
        first, left = self._upcoming, len(self._seeds) - self._upcoming
        fresh, spare = ended[:left], ended[left:]
        self.rows = np.setdiff1d(self.rows, spare)
        if len(fresh):
            self._upcoming = first + len(fresh)
            self.obs[fresh] = self.engine.reset_some(fresh, self._seeds[first : self._upcoming])
            self._episode[fresh] = np.arange(first, self._upcoming)
            self._elapsed[fresh] = 0
        return fresh
