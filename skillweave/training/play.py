"""The loop that plays whole episodes, for evaluation, periodic evaluation and videos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from skillweave._internal.policy_protocol import Policy
from skillweave.envs.engine import Engine
from skillweave.envs.env_infos import allowed_rows
from skillweave.policies.core import (
    Array,
    Memory as InPlaceMemory,
    Step,
    Turn,
    World,
    flat,
    put,
    split,
    take,
)
from skillweave.skills.skill_set import in_place


@dataclass(slots=True)
class PlayedStep:
    """One step in each environment that acts; arrays have a row for each of these."""

    rows: Array  # (k,) int64, the environments
    episode: Array  # (k,) int64, the episode that each of them plays
    step: Step  # ``elapsed`` counts the episode's environment steps
    reward: Array  # (k,) undiscounted; of a call the sum over its steps
    lasted: Array  # (k,) int64, environment steps that the action lasted
    cut: Array  # (k,) bool: the episode was cut at the step limit without an end
    memory: InPlaceMemory = field(default_factory=dict)
    """The policy's, of all environments, after the step."""
    acting: Array | None = None  # (k,) int64, the skill that acted; None: no skills below
    call_start: Array = field(default_factory=lambda: np.zeros(0, bool))
    """(k,) bool: a call of that skill starts."""

    @property
    def over(self) -> Array:
        """Mask (k,) bool of episodes that have ended, or were cut."""
        over: Array = self.step.terminated | self.step.truncated | self.cut
        return over


def play(
    policy: Policy,
    episodes: SeededEpisodes,
    *,
    deterministic: bool = True,
    rng: np.random.Generator | None = None,
    before_step: Callable[[InPlaceMemory], None] | None = None,
    seed: int = 0,
) -> Iterator[PlayedStep]:
    """Play all episodes, a step at a time.

    Args:
        deterministic: act greedily, else sample with ``rng``.
        before_step: called with the policy's memory, of all environments, after it has chosen an
            action, before the environments step.
        seed: of the goals of a skill that acts alone: each episode has its own.
    """
    n = episodes.num_envs
    acts = in_place(policy)
    world = World(rng)
    memory = acts.start(n)
    choose_goals = getattr(policy, "choose_goals", None)
    shown = split(flat(memory))  # the same arrays

    def begin(rows: Array) -> None:
        """Let a skill that acts alone choose goals where episodes start."""
        if choose_goals is not None and len(rows):
            rngs = [np.random.default_rng([seed, 2, n]) for n in episodes.episode[rows].tolist()]
            choose_goals(memory, rows, episodes.obs[rows], rngs)

    begin(episodes.rows)
    while len(rows := episodes.rows):
        mask = allowed_rows(episodes.engine.mask(), rows)
        turn = Turn(world, mask, greedy=deterministic)
        action = acts.act(memory, rows, episodes.obs[rows], turn)
        if before_step is not None:
            before_step(memory)
        acting = policy.acting({k: v[rows] for k, v in memory.items() if not isinstance(v, dict)})
        before = memory["elapsed"][rows] if "elapsed" in memory else np.ones(len(rows))
        played = episodes.step(action)
        acts.observe(memory, rows, played.step)
        played.memory = shown
        played.acting = acting
        played.call_start = before == 0
        yield played
        restarted = episodes.advance(played)
        if len(restarted):
            put(memory, restarted, take(acts.start(n), restarted))
            begin(restarted)


class SeededEpisodes:
    """Whole episodes in an engine.

    Args:
        seeds: one for each episode; or one for all: then each environment plays one episode, and
            all start at once.
        max_steps: an episode without an end by then is cut.
    """

    def __init__(self, engine: Engine, seeds: Sequence[int] | int, max_steps: int) -> None:
        self.engine = engine
        self.num_envs = engine.num_envs
        self.rows = np.arange(self.num_envs)
        """(k,) acting environments; empty: all episodes are over."""
        self._seeds = [] if isinstance(seeds, int) else seeds
        self._max_steps = max_steps
        self.episode = np.arange(self.num_envs)
        """(N,) the numbers of their episodes."""
        self._elapsed = np.zeros(self.num_envs, np.int64)
        if isinstance(seeds, int):
            self._upcoming = 0
            first = engine.reset(seeds)
        else:
            self.rows = self.rows[: len(seeds)]
            self._upcoming = len(self.rows)
            first = engine.reset_some(self.rows, list(seeds[: self._upcoming]))
        self.obs = np.array(first)
        """(N, *obs_shape), the next observations."""

    def step(self, action: Array) -> PlayedStep:
        """Step the environments of the episodes in ``rows``."""
        rows = self.rows
        obs = self.obs[rows]
        raw = self.engine.step(action, rows)
        self._elapsed[rows] += 1
        self.obs[rows] = raw.next_obs
        elapsed = self._elapsed[rows]
        step = raw.seen(obs, action, elapsed)
        cut = ~(raw.terminated | raw.truncated) & (elapsed >= self._max_steps)
        one = np.ones(len(rows), np.int64)
        return PlayedStep(rows, self.episode[rows], step, raw.reward, one, cut)

    def advance(self, played: PlayedStep) -> Array:
        """Start remaining episodes where others are over; return these environments (m,)."""
        ended = played.rows[played.over]
        first = self._upcoming
        left = len(self._seeds) - first
        restarted, idle = ended[:left], ended[left:]
        self.rows = np.setdiff1d(self.rows, idle)
        if len(restarted):
            self._upcoming = first + len(restarted)
            seeds = self._seeds[first : self._upcoming]
            self.obs[restarted] = self.engine.reset_some(restarted, seeds)
            self.episode[restarted] = np.arange(first, self._upcoming)
            self._elapsed[restarted] = 0
        return restarted
