"""The engine of EnvPool: C++ threads, the same dynamics, several times the speed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.envs.engine import RawStep, WatchedEngine
from skillweave.envs.pool import MakePool, installed, no_precision_warnings
from skillweave.errors import EnvError, MissingExtra
from skillweave.policies.core import Array
from skillweave.spaces import pack

RENEW_AFTER = 100_000
"""Steps since the seed of a pool after which environments move to a new pool."""


class EnvPoolEngine(WatchedEngine):
    """Environments of a pool: EnvPool's, or one that a user wraps.

    A pool is seeded when it is created, so an environment can be repeated only from there. To keep
    that short, a second pool is created after ``RENEW_AFTER`` steps, and each environment moves to
    it when its episode ends. A pool's seed follows from the first seed and the number of pools so
    far, so no result depends on the time of a checkpoint.

    Args:
        make: creates a pool.
        name: the environment's name in messages.
        spaces: the same environment of Gymnasium.
    """

    def __init__(
        self, make: MakePool, name: str, num_envs: int, threads: int, spaces: gym.Env[Any, Any]
    ) -> None:
        # EnvPool may state looser bounds; Gymnasium's are the reference (see `supports`).
        super().__init__(spaces, num_envs, name)
        self._make = make
        self._threads = min(threads, num_envs)
        self._made = 0  # pools since the root seed
        self._pools: list[Any] = []
        self._seeds: list[int] = []  # of the pools
        self._place = np.zeros(num_envs, np.int64)  # the pool of each environment

    @staticmethod
    def supports(env_id: str, reference: gym.Env[Any, Any]) -> bool:
        """Return whether EnvPool is installed and has this environment (spaces, limit)."""
        try:
            envpool = installed()
        except MissingExtra:
            return False
        if env_id not in envpool.list_all_envs():
            return False
        if reference.observation_space.shape is None:  # Dict, Tuple: EnvPool nests differently
            return False
        with no_precision_warnings():
            spec = envpool.make_spec(env_id)
            theirs = (spec.gymnasium_observation_space, spec.gymnasium_action_space)
        ours = (reference.observation_space, reference.action_space)
        same = all(
            isinstance(a, type(b))
            and a.shape == b.shape
            and getattr(a, "n", 0) == getattr(b, "n", 0)
            for a, b in zip(ours, theirs, strict=True)
        )
        dtype = isinstance(theirs[1], gym.spaces.Discrete) or theirs[1].dtype == ours[1].dtype
        limit = reference.spec.max_episode_steps if reference.spec else None
        return bool(
            same
            and dtype
            and theirs[0].dtype == ours[0].dtype
            and spec.config.max_episode_steps == limit
        )

    def make_pool(self, seed: int) -> Any:
        """Return a bare pool."""
        return self._make(self.num_envs, self._threads, seed)

    def reset(self, seed: int) -> Array:
        """Reset all environments from one seed; return observations (N, *obs_shape)."""
        self._root = seed
        self._made = 1
        self._pools = [self.make_pool(seed)]
        self._seeds = [seed]
        self._place[:] = 0
        self._history.forget(self._all)
        return self._begin(self._all)

    def reset_some(self, ids: Array, seeds: Sequence[int] | None = None) -> Array:
        """Reset some environments; return observations (n, *obs_shape)."""
        if seeds is not None:
            raise EnvError("EnvPool cannot reset single environments to a seed")
        if len(self._pools) == 1 and self._history.total >= RENEW_AFTER:
            self._add_pool()
        newest = len(self._pools) - 1
        moves = self._place[ids] != newest
        self._history.begin(ids[~moves])
        self._history.forget(ids[moves])
        self._place[ids] = newest
        if newest and self._place.all():
            del self._pools[0], self._seeds[0]
            self._place[:] = 0
        return self._begin(ids)

    def _add_pool(self) -> None:
        """Create the next pool, with its own seed."""
        node = np.random.SeedSequence(self._root, spawn_key=(self._made,))
        seed = int(node.generate_state(1, np.uint32)[0] >> 1)
        self._made += 1
        self._pools.append(self.make_pool(seed))
        self._seeds.append(seed)

    def state(self) -> dict[str, Array]:
        """Return the seeds and the actions since."""
        pools = {"seeds": np.array(self._seeds), "place": self._place.copy()}
        pools["root"] = np.array([self._root, self._made])
        return pools | self._history.state()

    def restore(self, state: dict[str, Array]) -> tuple[Array, Array]:
        """Repeat all actions; return observations (N, *obs_shape) and early ends (k,)."""
        self._seeds = [int(seed) for seed in state["seeds"]]
        self._place = state["place"].copy()
        self._root, self._made = (int(x) for x in state["root"])
        self._history.load(state)
        self._pools = [self.make_pool(seed) for seed in self._seeds]
        obs = np.array(self._begin(self._all))
        over = np.zeros(self.num_envs, bool)
        early = np.zeros(self.num_envs, bool)
        for begins, ids, action in self._history.play():
            if len(begins):
                obs[begins] = self._begin(begins)
                over[begins] = False
            early |= over
            if len(ids):
                raw = self._act(action, ids)
                obs[ids] = raw.next_obs
                over[ids] = raw.terminated | raw.truncated
        return obs, np.flatnonzero(early | over)

    def close(self) -> None:
        """Release the environments."""
        super().close()
        self._pools = []

    def _begin(self, ids: Array) -> Array:
        """Reset environments ``ids`` in their pools."""

        def reset(pool: Any, part: Array) -> tuple[Any, ...]:
            obs, info = pool.reset(ids[part].astype(np.int32))
            return pack(self.observation_space, obs), info

        obs, info = _in_order(self._parts(ids), reset)
        return self._after_reset(obs, info, ids)

    def _act(self, action: Array, ids: Array) -> RawStep:
        """Step environments ``ids`` in their pools."""
        if self._discrete:
            action = action.astype(np.int32)

        parts = self._parts(ids)
        for pool, part in parts:
            if _steps_apart(pool):  # then all have their actions before the first is waited for
                pool.send(action[part], ids[part].astype(np.int32))

        def step(pool: Any, part: Array) -> tuple[Any, ...]:
            if _steps_apart(pool):
                obs, *rest = pool.recv(reset=False, return_info=True)
            else:
                obs, *rest = pool.step(action[part], ids[part].astype(np.int32))
            return pack(self.observation_space, obs), *rest

        # An episode that terminates in the step of its time limit arrives as truncated: EnvPool
        # computes `terminated = done & ~truncated`, so the two cannot be distinguished.
        return self._after_step(RawStep(*_in_order(parts, step)), ids)

    def _parts(self, ids: Array) -> list[tuple[Any, Array]]:
        """Return each pool with some of environments ``ids`` (k,), and their places in ``ids``."""
        if len(self._pools) == 1:
            return [(self._pools[0], np.arange(len(ids)))]
        places = [np.flatnonzero(self._place[ids] == k) for k in range(len(self._pools))]
        return [(p, at) for p, at in zip(self._pools, places, strict=True) if len(at)]


def _steps_apart(pool: Any) -> bool:
    """Return whether a pool is EnvPool's own, which takes actions and returns the step later."""
    return hasattr(type(pool), "send")


def _in_order(
    parts: list[tuple[Any, Array]], call: Callable[[Any, Array], tuple[Any, ...]]
) -> tuple[Any, ...]:
    """Call ``call`` for each pool with its places; join the results in the order of places."""
    if len(parts) == 1:
        return call(*parts[0])
    answers = [(part, call(pool, part)) for pool, part in parts]
    n = sum(len(part) for part, _ in answers)
    return tuple(
        _joined([(part, result[i]) for part, result in answers], n)
        for i in range(len(answers[0][1]))
    )


def _joined(parts: list[tuple[Array, Any]], n: int) -> Any:
    """Join arrays, or dicts of arrays, of some rows each, to arrays of all n rows."""
    _, first = parts[0]
    if isinstance(first, dict):
        return {k: _joined([(rows, part[k]) for rows, part in parts], n) for k in first}
    joined = np.zeros((n, *first.shape[1:]), first.dtype)  # zeros between the parts of a Dict
    for rows, part in parts:
        joined[rows] = part
    return joined
