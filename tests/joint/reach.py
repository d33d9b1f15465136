"""A task with an action of several parts, and skills for it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

import skillweave as sw

SMALL = sw.Network(hidden=(8,))
ON = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=2, network=SMALL)

SPACES = {
    "dict": Dict(arm=Box(-2, 2, (2,), np.float32), grip=Discrete(2, start=3)),
    "tuple": Tuple((Box(-2, 2, (2,), np.float32), Discrete(2, start=3))),
    "nested": Dict(
        arm=Box(-2, 2, (2,), np.float32),
        grip=Discrete(2, start=3),
        more=Tuple((MultiBinary(3), Dict(a=MultiDiscrete([[2, 3]]), b=Box(-1, 2, (), np.int16)))),
        speed=Box(-np.inf, np.inf, (1,), np.float64),
    ),
    "whole": Box(np.array([[-1], [0]]), np.array([[1], [5]]), dtype=np.int64),
}


class Reach(gym.Env[Any, Any]):
    """Put the arm on a target, and shut the grip where the third number is above zero.

    The best return is 10, one for each step. ``kind`` says of what space actions are; each has to
    be one of it, and is noted in ``actions``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = Box(-1, 1, (3,), np.float32)

    def __init__(self, kind: str = "dict", render_mode: str | None = None, info=None):
        self.action_space, self.kind, self.render_mode = SPACES[kind], kind, render_mode
        self.info = info or {}
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._draw(), self.info

    def _draw(self):
        self.obs = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return self.obs.copy()

    def step(self, action):
        assert self.action_space.contains(action), action
        self.actions.append(action)
        if self.kind == "whole":
            wanted = np.round(self.obs[:2] * 1.5 + [0, 2.5])
            reward = 1.0 - np.abs(action.reshape(-1) - wanted).sum() / 2
        else:
            arm, grip = action if self.kind == "tuple" else (action["arm"], action["grip"])
            reward = 0.5 - 0.5 * np.abs(arm - self.obs[:2]).sum()
            reward += 0.5 * ((grip == 4) == (self.obs[2] > 0))
        self.steps += 1
        return self._draw(), float(reward), False, self.steps >= 10, self.info

    def render(self):
        return np.full((32, 32, 3), 20 * self.steps, np.uint8)


class Arm(sw.Skill):
    """Moves the arm alone."""

    acts = "arm"

    def reward(self, step: sw.Step):
        return -np.abs(step.action["arm"] - step.obs[:, :2]).sum(axis=1)


class Grip(sw.Skill):
    """Moves the grip alone."""

    acts = ("grip",)

    def reward(self, step: sw.Step):
        return ((step.action["grip"] == 4) == (step.obs[:, 2] > 0)).astype(np.float32)


class Whole(sw.Skill):
    """Moves both."""


def by_hand(obs):
    """The best action."""
    return {"arm": obs[:, :2], "grip": 3 + (obs[:, 2] > 0)}


class Ready(sw.Skill):
    """Does the best action."""

    def policy(self, obs):
        return by_hand(obs)


def on(kind: str = "dict", **kwargs) -> sw.EnvSpec:
    return sw.EnvSpec(Reach, {"kind": kind, **kwargs}, engine="sync", workers=1)


def reach(skills=None, **how) -> sw.Hierarchy:
    """Return a hierarchy with small budgets."""
    settings = {
        "env": on(),
        "call_steps": 3,
        "steps": 400,
        "algorithm": ON,
        "selector": ON,
    } | how
    skills = skills or [Arm(), Grip(), Whole(), Ready()]
    return sw.Hierarchy(settings.pop("env"), skills, **settings)
