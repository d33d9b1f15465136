"""The lander of ``lander-missions``: up to three legs, and gusts.

A mission is defined in one place, ``MissionState``, for one environment (``MissionTask``) as for
many side by side in EnvPool (``MissionPool``).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import EnvSpec
from skillweave.envs import PoolWrapper, envpool
from skillweave.errors import DeclarationError
from skillweave.recipes._specs import OwnTask, named
from skillweave.types import Array

LANDER = "LunarLander-v3"
EPISODE = 1000
"""Steps of an episode, at most: 20 seconds, as LunarLander's."""
KINDS = ("left", "right", "hover", "land")
"""The kinds of legs of a mission."""
LEFT, RIGHT, HOVER, LAND = range(4)
LEGS = 3
"""The most legs that a mission has."""
POINTS = np.array([(-0.5, 0.75), (0.5, 0.75), (0.0, 0.6)])
"""Places of left, right and hover: x and y as the lander sees them."""
HALF = np.array([(0.15, 0.15), (0.15, 0.15), (0.2, 0.2)])
"""Half the width and height of the boxes around these points."""
HOVER_STEPS = 100
"""Two seconds."""
PAD = 0.2
"""Half the width of the pad, as the lander sees it."""
RESTED = 100.0
"""Reward of LunarLander in the step in which the lander has come to rest, and in no other."""
GUST_EVERY = 80
"""Steps from one gust to the next."""
GUST_STEPS = 8
"""Steps that a gust lasts."""
SIZE = 8 + LEGS * len(KINDS) + 1


class MissionState:
    """The progress of the missions of ``num_envs`` environments.

    Args:
        missions: each names its legs; each episode has one of them.
        gusts: in a gust the engine on one side fires, whatever the pilot wants.

    Raises:
        DeclarationError: a mission has too few or too many legs, or one that there is not.
    """

    def __init__(self, num_envs: int, missions: Sequence[Sequence[str]], gusts: bool) -> None:
        for mission in missions:
            unknown = [leg for leg in mission if leg not in KINDS]
            if unknown or not 1 <= len(mission) <= LEGS:
                raise DeclarationError(
                    f"a mission has 1 to {LEGS} legs of {', '.join(KINDS)}, not {tuple(mission)}"
                )
        rows = [[KINDS.index(leg) for leg in m] + [-1] * (LEGS - len(m)) for m in missions]
        self._missions = np.array(rows)
        self._gusts = gusts
        self.left = np.full((num_envs, LEGS), -1)
        """The remaining legs, (num_envs, 3): numbers of kinds, in order; −1: no leg."""
        self.held = np.zeros(num_envs, np.int64)
        """Steps for which the lander has hovered in the box."""
        self.legs = np.ones(num_envs, np.int64)
        """The number of legs of the whole mission."""
        self._time = np.zeros(num_envs, np.int64)

    def begin(self, ids: Array, rngs: Sequence[np.random.Generator]) -> None:
        """Start missions in environments ``ids`` (k,); ``rngs`` has one generator for each."""
        which = [int(rng.integers(len(self._missions))) for rng in rngs]
        self.left[ids] = self._missions[which]
        self.held[ids] = 0
        self.legs[ids] = (self.left[ids] >= 0).sum(axis=1)
        self._time[ids] = [int(rng.integers(2 * GUST_EVERY)) for rng in rngs]

    def blown(self, action: Array, ids: Array) -> Array:
        """Return the engines' actions (k,) after gusts, for the wanted ``action`` (k,)."""
        if not self._gusts:
            return action
        gust = self._time[ids] % GUST_EVERY < GUST_STEPS
        side = np.where(self._time[ids] // GUST_EVERY % 2, 1, 3)
        return np.where(gust, side, action).astype(action.dtype)

    def advance(self, obs: Array, reward: Array, ended: Array, ids: Array) -> Array:
        """Return the rewards (k,): for a leg that this step has done, its share of the mission.

        Args:
            obs: the lander's, after the step (k, 8).
            reward: LunarLander's, (k,).
            ended: the episode has ended, for whatever reason, (k,) bool.
        """
        self._time[ids] += 1
        leg = self.left[ids, 0]
        place = obs[:, :2]
        at = np.clip(leg, 0, LAND - 1)
        inside = (np.abs(place - POINTS[at]) <= HALF[at] + 1e-6).all(axis=1)
        hovering = inside & (leg == HOVER)
        held = np.where(hovering, self.held[ids] + 1, 0)
        rested = ended & (reward == RESTED)
        done = (leg >= 0) & (leg < HOVER) & inside
        done |= held >= HOVER_STEPS
        done |= (leg == LAND) & rested & (np.abs(place[:, 0]) <= PAD)
        self.held[ids] = np.where(done, 0, held)
        after = np.roll(self.left[ids], -1, axis=1)
        after[:, -1] = -1
        self.left[ids] = np.where(done[:, None], after, self.left[ids])
        paid: Array = (done / self.legs[ids]).astype(np.float32)
        return paid

    def done(self, ids: Array) -> Array:
        """Return whether the whole mission is done, (k,) bool."""
        done: Array = self.left[ids, 0] < 0
        return done

    def seen(self, obs: Array, ids: Array) -> Array:
        """Return the lander's observations (k, 8), and the mission's after them: (k, 21)."""
        legs = self.left[ids][:, :, None] == np.arange(len(KINDS))
        parts = (obs, legs.reshape(len(ids), -1), self.held[ids, None] / HOVER_STEPS)
        return np.concatenate(parts, axis=1, dtype=np.float32)


SPACE = gym.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)


class MissionTask(OwnTask):
    """One lander with a mission; ``info["success"]`` is true where all of it is done."""

    def __init__(
        self, env: gym.Env[Any, Any], missions: Sequence[Sequence[str]], gusts: bool = False
    ) -> None:
        super().__init__(env)
        self.progress = MissionState(1, missions, gusts)
        self._me = np.zeros(1, np.int64)
        self._rng = np.random.default_rng()
        self.observation_space = SPACE

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start an episode with a new mission."""
        obs, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.progress.begin(self._me, [self._rng])
        return self.progress.seen(obs[None], self._me)[0], info

    def step(self, action: Any) -> Any:
        """Pay a share of 1 for each leg that is done."""
        action = self.progress.blown(np.asarray([action]), self._me)[0]
        obs, reward, terminated, truncated, info = self.env.step(int(action))
        ended = np.array([terminated or truncated])
        paid = self.progress.advance(obs[None], np.array([reward]), ended, self._me)
        info = info | {"success": bool(self.progress.done(self._me)[0])}
        seen = self.progress.seen(obs[None], self._me)[0]
        return seen, float(paid[0]), terminated, truncated, info

    def render(self) -> Any:
        """Return the picture, with the box of the leg that is flown now."""
        frame = self.env.render()
        leg = int(self.progress.left[0, 0])
        if isinstance(frame, np.ndarray) and 0 <= leg < LAND:
            frame = frame.copy()
            (left, right), (top, bottom) = _pixels(POINTS[leg], HALF[leg], frame.shape)
            for rows, columns in (
                ((top, top + 2), (left, right)),
                ((bottom - 2, bottom), (left, right)),
                ((top, bottom), (left, left + 2)),
                ((top, bottom), (right - 2, right)),
            ):
                frame[slice(*rows), slice(*columns)] = (255, 200, 0)
        return frame


def _pixels(point: Array, half: Array, shape: Sequence[int]) -> tuple[Any, Any]:
    """Return the columns and rows of a box in LunarLander's picture."""
    x = (1.0 + point[0] + half[0] * np.array([-1.0, 1.0])) * shape[1] / 2.0
    # The pad's height is a quarter of the picture, and the legs reach 18 pixels below the middle.
    above = 0.25 * shape[0] + 18.0
    y = shape[0] - above - (point[1] + half[1] * np.array([1.0, -1.0])) * shape[0] / 2.0
    return x.astype(int), y.astype(int)


class MissionPool(PoolWrapper):
    """Many landers with missions.

    Args:
        pool: landers.
        num_envs: number of landers.
        seed: the seed of missions and gusts.
    """

    def __init__(
        self, pool: Any, missions: Sequence[Sequence[str]], gusts: bool, num_envs: int, seed: int
    ) -> None:
        super().__init__(pool, SPACE)
        self.progress = MissionState(num_envs, missions, gusts)
        self._rngs = [np.random.default_rng([seed, i]) for i in range(num_envs)]

    def reset(self, ids: Array) -> tuple[Any, dict[str, Any]]:
        """Start new missions."""
        obs, info = self.pool.reset(ids)
        self.progress.begin(ids, [self._rngs[i] for i in ids])
        return self.progress.seen(obs, ids), info

    def step(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Take a step as ``Mission.step`` does, for all landers."""
        action = self.progress.blown(action, ids)
        obs, reward, terminated, truncated, info = self.pool.step(action, ids)
        paid = self.progress.advance(obs, reward, terminated | truncated, ids)
        info = info | {"success": self.progress.done(ids)}
        return self.progress.seen(obs, ids), paid, terminated, truncated, info


def make(
    missions: Sequence[Sequence[str]], gusts: bool = False, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Make one lander whose episodes have one of these missions."""
    lander = gym.make(
        LANDER, max_episode_steps=EPISODE, render_mode=render_mode, disable_env_checker=True
    )
    return MissionTask(lander, missions, gusts)


def many(
    missions: Sequence[Sequence[str]], gusts: bool, num_envs: int, threads: int, seed: int
) -> MissionPool:
    """Make these landers in EnvPool."""
    pool = envpool(LANDER, num_envs, threads, seed, max_episode_steps=EPISODE)
    return MissionPool(pool, missions, gusts, num_envs, seed)


def spec(name: str, missions: Sequence[Sequence[str]], gusts: bool = False) -> EnvSpec:
    """Return the landers with these missions, for ``Hierarchy(env=...)``.

    Args:
        name: the task's name in runs.
    """
    how = missions, gusts
    return named(f"Lander({name})", partial(make, *how), partial(many, *how))
