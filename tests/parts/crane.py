"""A crane with an arm and a hook, and skills that own one or the other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from playing import episode
from small_runs import goes_on

import skillweave as sw

SMALL = sw.Network(hidden=(8,))
GREEDY = sw.Selection(greedy_skills=True, greedy_selector=True)
ON = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=2, network=SMALL)


class Crane(gym.Env):
    """An arm of two numbers and a hook of one; an episode has 20 steps.

    ``kind`` says of what space actions are.
    """

    observation_space: Any = gym.spaces.Dict(
        {
            "arm": gym.spaces.Box(-2, 2, (2,), np.float32),
            "hook": gym.spaces.Box(-2, 2, (1,), np.float32),
            "camera": gym.spaces.Box(0, 255, (8, 8, 3), np.uint8),
            "mode": gym.spaces.Discrete(3),
        }
    )

    def __init__(self, kind: str = "box", masked: bool = False) -> None:
        self.kind, self.masked = kind, masked
        self.action_space: Any = {
            "box": gym.spaces.Box(-1, 1, (3,), np.float32),
            "several": gym.spaces.MultiDiscrete([3, 3, 2]),
            "bits": gym.spaces.MultiBinary(3),
            "one": gym.spaces.Discrete(4),
        }[kind]

    def _obs(self) -> Any:
        picture = np.full((8, 8, 3), self.steps, np.uint8)
        arm, hook = self.place[:2].copy(), self.place[2:].copy()
        return {"arm": arm, "hook": hook, "camera": picture, "mode": self.steps % 3}

    def _info(self) -> dict[str, Any]:
        if not self.masked:
            return {}
        size = {"several": 8, "bits": 6, "one": 4}[self.kind]
        mask = np.ones(size, np.int8)
        mask[self.steps % 2] = 0
        return {"action_mask": mask}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 3).astype(np.float32), 0
        return self._obs(), self._info()

    def step(self, action: Any) -> Any:
        push = np.zeros(3, np.float32)
        if self.kind == "one":
            push[action % 3] = 1.0
        else:
            push[:] = np.asarray(action, np.float32)
        self.place = np.clip(self.place + 0.2 * push, -2, 2).astype(np.float32)
        self.steps += 1
        reward = -float(np.abs(self.place).sum())
        return self._obs(), reward, False, self.steps >= 20, self._info()


class Arm(sw.Skill):
    """Moves the arm to the middle."""

    sees, acts = "arm", slice(0, 2)

    def reward(self, step: sw.Step) -> Any:
        return -np.abs(step.next_obs["arm"]).sum(axis=1)


class Hook(sw.Skill):
    """Lifts the hook."""

    sees, acts = ("hook", "mode"), 2

    def reward(self, step: sw.Step) -> Any:
        return step.next_obs["hook"][:, 0]


def acted(actor: Any) -> Any:
    """Return the actions of an episode, (20, 3)."""
    return np.array([action for (action,) in episode(Crane(), actor)])


def crane(skills: Any = None, **how: Any) -> sw.Hierarchy:
    """Return a hierarchy on the crane, with small budgets."""
    settings: dict[str, Any] = {
        "env": sw.EnvSpec(Crane, engine="sync", workers=1),
        "call_steps": 4,
        "steps": 400,
        "algorithm": ON,
        "selector": ON,
    } | how
    return sw.Hierarchy(settings.pop("env"), skills or [Arm(), Hook()], **settings)


def greedy(skills: Any = None, **how: Any) -> sw.Run:
    """Return a short run, whose skills and selector act greedily."""
    return crane(skills, **{"steps": 130, "selection": GREEDY} | how).train(seed=0, quiet=True)


def goes_on_and_loads(hierarchy: Callable[[], sw.Hierarchy], folder: Path) -> None:
    """Assert that a stopped run ends with the same weights, and that these load in both ways."""
    whole = goes_on(hierarchy, folder)
    returns = whole.evaluate(3).returns
    assert hierarchy().load(whole.path).evaluate(3).returns == returns
    file = whole.save_weights(folder / "weights.safetensors")
    assert hierarchy().load_weights(file).evaluate(3).returns == returns
