"""Engines: many environments of one kind, stepped together, reset only when told.

Gymnasium resets on the next step, in the same step or never; EnvPool resets on the next step
and ignores the action sent then. An ``Engine`` knows none of this: ``step`` steps the
environments named and returns their true successors, ``reset_some`` starts those named anew.
An environment that has ended must be reset before the next step. An episode that nothing else
ends is truncated after ``LONGEST_EPISODE`` steps.

``state`` is what ``restore`` needs to bring the environments where they are: their seeds and what
was done since. Only an environment whose dynamics follow from these two can be restored.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from skillweave.envs.checks import Watch, time_limit
from skillweave.envs.history import History
from skillweave.envs.infos import ActionMasks
from skillweave.envs.sync import SyncEnvs
from skillweave.notices import are_collected, notice
from skillweave.seeding import GlobalDraws
from skillweave.types import Array

LOOKS = 12
"""Resets and steps in which it is seen whether environments draw from global generators."""


@dataclass(slots=True)
class RawStep:
    """The environments' answer, rows in the order of the ids asked for."""

    next_obs: Array  # (n, *obs_shape)
    reward: Array  # (n,) float32
    terminated: Array  # (n,) bool
    truncated: Array  # (n,) bool
    info: dict[str, Any]


class Engine(Protocol):
    """N environments of one kind; ``ids`` are row numbers, None means all of them."""

    num_envs: int
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    steps_made: int
    """Steps that all environments have made together."""
    time_limit: int | None
    """Steps after which an environment itself truncates an episode; None: nobody knows."""

    def reset(self, seed: int) -> Array:
        """Start all anew from one seed; observations (N, *obs_shape)."""
        ...

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Start some anew; observations (n, *obs_shape). ``seeds``: one each, where supported."""
        ...

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Act in some environments; the others stand still."""
        ...

    def state(self) -> dict[str, Array]:
        """Seeds, and what was done since: all that ``restore`` needs."""
        ...

    def restore(self, state: dict[str, Array]) -> tuple[Array, Array]:
        """Play everything in ``state`` again.

        The steps are not counted: they were when they were made first.

        Returns:
            The observations (N, *obs_shape) that this led to, and (k,) environments whose episodes
            ended before they did the first time: they must be reset.
        """
        ...

    def mask(self) -> Array | None:
        """(N, A) bool, the actions allowed in the latest observations; None: all always are."""
        ...

    def close(self) -> None:
        """Release processes and memory."""
        ...


class GymnasiumEngine:
    """Gymnasium environments, one after another in this process.

    Every episode begins from a seed of its own, so that it can be played again.

    Args:
        first: the number of the first environment, for messages.
    """

    def __init__(self, make: Any, num_envs: int, name: str, first: int = 0) -> None:
        makers = [functools.partial(make, number=first + i) for i in range(num_envs)]
        self._envs = SyncEnvs(makers, name)
        self.num_envs, self.steps_made = num_envs, 0
        self.observation_space: gym.Space[Any] = self._envs.observation_space
        self.action_space: gym.Space[Any] = self._envs.action_space
        self.time_limit = time_limit(self._envs.envs[0])
        self._masks = ActionMasks(
            self.action_space, num_envs, observation_space=self.observation_space
        )
        self._watch = Watch(name, self.observation_space, num_envs, first)
        self._name, self._draws = name, GlobalDraws(LOOKS if are_collected() else 0)
        empty = gym.vector.utils.create_empty_array(self.action_space, num_envs, np.zeros)
        self._all = np.arange(num_envs)
        self._root = 0
        self._episode = np.zeros(num_envs, np.int64)  # episodes begun since the root seed
        self._seed = np.zeros(num_envs, np.int64)  # of the open episode
        self._history = History(num_envs, np.asarray(empty))

    def reset(self, seed: int) -> Array:
        """Start all anew from one seed; observations (N, *obs_shape)."""
        self._root, self._episode[:] = seed, 0
        return self.reset_some(self._all)

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Start some anew; observations (n, *obs_shape)."""
        if seeds is None:
            seeds = [self._next_seed(int(i)) for i in ids]
        self._episode[ids] += 1
        self._seed[ids] = seeds
        self._history.forget(ids)
        return self._begin(ids)

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        """Act in some environments; the others stand still."""
        rows = self._all if ids is None else ids
        self._history.add(action, rows)
        self.steps_made += len(rows)
        return self._act(action, ids)

    def state(self) -> dict[str, Array]:
        """Seeds, and what was done since."""
        own = {"root": np.array([self._root]), "episode": self._episode, "seed": self._seed}
        return {k: v.copy() for k, v in own.items()} | self._history.state()

    def restore(self, state: dict[str, Array]) -> tuple[Array, Array]:
        """Play the open episodes again; observations (N, *obs_shape), and who ended early."""
        n = self.num_envs
        belongs = (("root", 1, 2**63 - 1), ("episode", n, 2**62), ("seed", n, 2**31 - 1))
        for name, rows, most in belongs:
            found = state[name]
            if found.shape != (rows,) or found.dtype.kind != "i":
                raise ValueError(f"{name} is {found.dtype} {found.shape}, not whole numbers")
            if not ((found >= 0) & (found <= most)).all():
                raise ValueError(f"{name} is out of its range")
        self._root = int(state["root"][0])
        self._episode, self._seed = state["episode"].copy(), state["seed"].copy()
        self._history.load(state)
        obs, early = self._begin(self._all), [np.zeros(0, np.int64)]
        for _, ids, action in self._history.play():
            if len(ids):
                raw = self._act(action, ids)
                obs[ids] = raw.next_obs
                ended = ids[raw.terminated | raw.truncated]
                if len(ended):  # what was done in them afterwards is left out
                    obs[ended] = self.reset_some(ended)
                    early.append(ended)
        return obs, np.unique(np.concatenate(early))

    def mask(self) -> Array | None:
        """(N, A) bool, the actions allowed in the latest observations; None: all always are."""
        return self._masks.now

    def close(self) -> None:
        """Release the environments."""
        self._envs.close()

    def _next_seed(self, row: int) -> int:
        return episode_seed(self._root, row, int(self._episode[row]))

    def _begin(self, ids: Array) -> Array:
        """Reset environments ``ids`` to their seeds."""
        if self._draws.looks:
            self._draws.begin()
        obs, info = self._envs.begin(ids, self._seed[ids])
        if self._draws.looks:
            self._tell_draws()
        self._masks.see(info, ids, obs=obs)
        return self._watch.begun(obs, ids)

    def _tell_draws(self) -> None:
        """Tell people if the environments have just drawn from global generators."""
        if drawn := self._draws.end():
            self._draws.looks = 0
            notice(
                f"{self._name} draws from {' and '.join(drawn)}, whose generator all of a program "
                "shares. The run seeds it, so the same seed gives the same weights; but an episode "
                "that is open when a run is resumed cannot be repeated. Draw from self.np_random "
                "instead, which super().reset(seed=seed) seeds"
            )

    def _act(self, action: Array, ids: Array | None) -> RawStep:
        rows = self._all if ids is None else ids
        # A copy: environments get views of it, and may keep them.
        acted = np.array(action, self.action_space.dtype)
        if self._draws.looks:
            self._draws.begin()
        next_obs, reward, terminated, truncated, info = self._envs.act(acted, rows)
        if self._draws.looks:
            self._tell_draws()
        self._masks.see(info, ids, terminated | truncated, next_obs)
        raw = RawStep(next_obs, reward.astype(np.float32), terminated, truncated, info)
        self._watch.stepped(raw, ids)
        raw.truncated = (truncated | self._watch.too_long(ids)) & ~terminated
        return raw


def episode_seed(root: int, row: int, episode: int) -> int:
    """Return the seed of an episode of environment ``row``, where all were reset to ``root``."""
    node = np.random.SeedSequence(root, spawn_key=(row, episode))
    return int(node.generate_state(1, np.uint32)[0] >> 1)


def checksums(obs: Array) -> Array:
    """Return a number for each row of observations (n, *obs_shape), (n,) int64; equal rows, equal ones."""
    found = [0] * len(obs)
    for part in _parts(obs):
        rows = (np.ascontiguousarray(row).tobytes() for row in part)
        found = [zlib.crc32(row, before) for row, before in zip(rows, found, strict=True)]
    return np.array(found, np.int64)


def _parts(obs: Array) -> list[Array]:
    """Observations (n, …) as arrays of numbers: what lies between aligned parts says nothing."""
    if obs.dtype.names is None:
        return [obs]
    return [part for name in obs.dtype.names for part in _parts(obs[name])]
