"""The loop that plays episodes: for evaluations, films, and logs of calls."""

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
    RowPolicy,
    Step,
    Turn,
    World,
    flat,
    restart,
    split,
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
    policy: Policy | RowPolicy,
    episodes: EngineEpisodes,
    *,
    deterministic: bool = True,
    rng: np.random.Generator | None = None,
    before_step: Callable[[InPlaceMemory], None] | None = None,
    seed: int = 0,
) -> Iterator[PlayedStep]:
    """Play all episodes, a step at a time.

    Args:
        policy: of any form; one that acts in place is of no skills.
        deterministic: act greedily, else sample with ``rng``.
        before_step: called with the policy's memory, of all environments, after it has chosen an
            action, before the environments step.
        seed: of the goals of a skill that acts alone: each episode has its own.
    """
    n = episodes.num_envs
    acts = in_place(policy)
    world = World(rng, episodes.elapsed)
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
        acting = None
        if not isinstance(policy, RowPolicy):
            own = {k: v[rows] for k, v in memory.items() if not isinstance(v, dict)}
            acting = policy.acting(own)
        before = memory["elapsed"][rows] if "elapsed" in memory else np.ones(len(rows))
        played = episodes.step(action)
        acts.observe(memory, rows, played.step)
        played.memory = shown
        played.acting = acting
        played.call_start = before == 0
        yield played
        restarted = episodes.advance(played)
        if len(restarted):
            restart(acts, memory, restarted)
            begin(restarted)


class EngineEpisodes:
    """EngineEpisodes in an engine, which a subclass starts.

    Args:
        max_steps: an episode without an end by then is cut; None: none is.
    """

    def __init__(self, engine: Engine, max_steps: int | None = None) -> None:
        self.engine = engine
        self.num_envs = engine.num_envs
        self.rows = np.arange(self.num_envs)
        """(k,) acting environments; empty: all episodes are over."""
        self.episode = np.arange(self.num_envs)
        """(N,) the numbers of their episodes."""
        self.elapsed = np.zeros(self.num_envs, np.int64)
        """(N,) steps of their episodes; the same array all the time."""
        self.obs: Array = np.zeros(0)
        """(N, *obs_shape), the next observations."""
        self._max_steps = np.inf if max_steps is None else max_steps

    def step(self, action: Array) -> PlayedStep:
        """Step the environments of the episodes in ``rows``."""
        rows = self.rows
        obs = self.obs[rows]
        raw = self.engine.step(action, rows)
        self.elapsed[rows] += 1
        self.obs[rows] = raw.next_obs
        elapsed = self.elapsed[rows]
        step = raw.seen(obs, action, elapsed)
        cut = ~(raw.terminated | raw.truncated) & (elapsed >= self._max_steps)
        one = np.ones(len(rows), np.int64)
        return PlayedStep(rows, self.episode[rows], step, raw.reward, one, cut)

    def advance(self, played: PlayedStep) -> Array:
        """Start episodes where others are over; return these environments (m,)."""
        raise NotImplementedError


class SeededEpisodes(EngineEpisodes):
    """Whole episodes in an engine.

    Args:
        seeds: one for each episode; or one for all: then each environment plays one episode, and
            all start at once.
        max_steps: an episode without an end by then is cut.
    """

    def __init__(self, engine: Engine, seeds: Sequence[int] | int, max_steps: int) -> None:
        super().__init__(engine, max_steps)
        self._seeds = [] if isinstance(seeds, int) else seeds
        if isinstance(seeds, int):
            self._upcoming = 0
            first = engine.reset(seeds)
        else:
            self.rows = self.rows[: len(seeds)]
            self._upcoming = len(self.rows)
            first = engine.reset_some(self.rows, list(seeds[: self._upcoming]))
        self.obs = np.array(first)

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
            self.elapsed[restarted] = 0
        return restarted
