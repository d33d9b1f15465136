"""A walk of nine steps with four calls, all known by hand; no training is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import EnvSpec, Hierarchy, Skill
from skillweave.policies.core import CallEnd
from skillweave.training.evaluation import episode_seeds, evaluate
from skillweave.training.played_calls import PlayedCalls, PlayedEpisodes
from skillweave.types import Array


class Walkway(gym.Env[Array, int]):
    """Action 1 walks a metre; each step pays the place, and the sixth metre ends it."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space: gym.Space[Any] = gym.spaces.Box(0, 100, (2,), np.float32)
    action_space: gym.Space[Any] = gym.spaces.Discrete(2)
    drift = 0.0

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode, self.at, self.time = render_mode, 0, 0

    def _seen(self) -> Array:
        return np.array([self.at, self.time], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.at = self.time = 0
        return self._seen(), {}

    def step(self, action: int) -> Any:
        self.at, self.time = self.at + int(action), self.time + 1
        return self._seen(), float(self.at), self.at >= 6, False, {}

    def render(self) -> Any:
        frame = np.full((40, 60, 3), 255, np.uint8)
        frame[10:30, : 10 * self.at] = (200, 0, 0)
        return frame


class Moody(Walkway):
    """The same, but pays more with each episode that anyone plays."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        type(self).drift += 1.0
        return super().reset(seed=seed, options=options)

    def step(self, action: int) -> Any:
        obs, reward, *rest = super().step(action)
        return obs, reward + self.drift, *rest


class Go(Skill):
    """Walks two metres."""

    def policy(self, obs: Array) -> Array:
        return np.ones(len(obs), np.int64)

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 0] % 2 == 0

    def success(self, step: Any) -> Array:
        return step.next_obs[:, 0] >= 6

    def reward(self, step: Any) -> Array:
        return np.full(len(step.reward), 2.0)


class Stay(Skill):
    """Waits for three steps."""

    max_steps = 3

    def policy(self, obs: Array) -> Array:
        return np.zeros(len(obs), np.int64)


def choose(obs: Array) -> Array:
    """Stay once, after two metres; else go."""
    return np.where((obs[:, 0] == 2) & (obs[:, 1] == 2), "stay", "go")


FIELDS = ("skill", "age", "steps", "end_reason", "task_return", "own_return", "succeeded")
CALLS = [
    (0, 0, 2, CallEnd.OWN, 3.0, 4.0, False),
    (1, 2, 3, CallEnd.LIMIT, 6.0, 6.0, False),
    (0, 5, 2, CallEnd.OWN, 7.0, 4.0, False),
    (0, 7, 2, CallEnd.OWN, 11.0, 4.0, True),
]
"""The calls of each episode, by hand."""


def told(calls: Any) -> list[tuple[Any, ...]]:
    """Return ``FIELDS`` of calls, as in ``CALLS``."""
    return list(zip(*(np.asarray(calls[name]).tolist() for name in FIELDS), strict=True))


def played(folder: Path, episodes: int = 1, env: Any = Walkway) -> PlayedEpisodes:
    """Train the walk, and play it."""
    run = declare(env).train(folder, quiet=True)
    spaces = run.policy.observation_space, run.policy.action_space
    calls = PlayedCalls(run.policy, spaces, own_rewards=True, inside=False)
    evaluate(run.policy, run.declaration.spec, episodes=episodes, watch=calls.add)
    return PlayedEpisodes(calls, episode_seeds(0, episodes))


def declare(env: Any = Walkway) -> Hierarchy:
    return Hierarchy(EnvSpec(env, engine="sync"), [Go(), Stay()], selector=choose, learn="apart")
