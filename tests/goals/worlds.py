"""A point in a square, and skills with goals of every kind for it."""

from __future__ import annotations

import gymnasium as gym
import numpy as np

import skillweave as sw

SMALL = sw.Network(hidden=(8,))
ON = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=2, network=SMALL)
SELECTOR = sw.PPO(num_envs=4, n_steps=64, batch_size=16, update_epochs=2, network=SMALL)
OFF = {"num_envs": 4, "batch_size": 16, "learning_starts": 20, "buffer_size": 500}
OFTEN = sw.TrainDefaults(checkpoint_every=60)
WAYS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]], np.float32)


class Point(gym.Env):
    """A point that is pushed; an episode has 30 steps."""

    observation_space = gym.spaces.Box(-2, 2, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, discrete: bool = False, as_dict: bool = False):
        self.discrete, self.as_dict = discrete, as_dict
        if discrete:
            self.action_space = gym.spaces.Discrete(4)
        if as_dict:
            place = gym.spaces.Box(-2, 2, (2,), np.float32)
            picture = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
            self.observation_space = gym.spaces.Dict({"place": place, "picture": picture})

    def _obs(self):
        if not self.as_dict:
            return self.place.copy()
        return {"place": self.place.copy(), "picture": np.full((8, 8, 3), self.steps, np.uint8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 2).astype(np.float32), 0
        return self._obs(), {}

    def step(self, action):
        push = WAYS[action] if self.discrete else np.asarray(action, np.float32)
        self.place = np.clip(self.place + 0.2 * push, -2, 2)
        self.steps += 1
        far = float(np.abs(self.place - 1).max())
        return self._obs(), float(far < 0.2), False, self.steps >= 30, {"success": far < 0.2}


class Drawn(Point):
    """A point that can be filmed."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None):
        super().__init__()
        self.render_mode = render_mode

    def render(self):
        frame = np.full((64, 64, 3), 220, np.uint8)
        x, y = (16 * (self.place + 2)).astype(int).clip(2, 61)
        frame[y - 2 : y + 3, x - 2 : x + 3] = (200, 30, 30)
        return frame


def place_of(obs):
    """Return where the point is, (n, 2)."""
    return obs["place"] if obs.dtype.fields else obs


SPACES = {
    "box": gym.spaces.Box(-1, 1, (2,), np.float32),
    "box of float64": gym.spaces.Box(np.array([-1.0, 0.0]), np.array([1.0, 2.0]), dtype=np.float64),
    "unbounded": gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
    "number": gym.spaces.Discrete(3, start=2),
    "numbers": gym.spaces.MultiDiscrete([3, 2]),
    "bits": gym.spaces.MultiBinary(2),
    "whole": gym.spaces.Box(-2, 2, (2,), np.int64),
    "dict": gym.spaces.Dict(
        {"at": gym.spaces.Box(-1, 1, (2,), np.float32), "side": gym.spaces.Discrete(2)}
    ),
    "tuple": gym.spaces.Tuple([gym.spaces.Box(-1, 1, (2,), np.float32), gym.spaces.Discrete(2)]),
    "picture": gym.spaces.Box(0, 255, (8, 8, 3), np.uint8),
}


def aim_of(goal):
    """Return a point (n, 2) to go to, of a goal of any of the spaces."""
    if goal.dtype.fields:
        goal = goal["at" if "at" in goal.dtype.names else "0"]
    flat = goal.reshape(len(goal), -1).astype(np.float64)
    return np.broadcast_to(flat[:, :2] % 2, (len(goal), 2))


class GoTo(sw.Skill):
    """Go to a point."""

    max_steps = 8
    goal_space = SPACES["box"]

    def reward(self, step):
        return -np.abs(place_of(step.next_obs) - aim_of(step.goal)).sum(1)

    def termination(self, step):
        return np.abs(place_of(step.next_obs) - aim_of(step.goal)).max(1) < 0.15

    def success(self, step):
        return np.abs(place_of(step.next_obs) - aim_of(step.goal)).max(1) < 0.15


class Rest(sw.Skill):
    """Stay where it is."""

    max_steps = 3

    def policy(self, obs):
        return np.zeros((len(obs), 2), np.float32)


def go_to(space: str = "box", **attributes) -> sw.Skill:
    """A ``GoTo`` for goals of a space."""
    return type("GoTo", (GoTo,), {"goal_space": SPACES[space], **attributes})()


def far_corner(obs):
    """A selector that is a rule: go to the far corner."""
    return np.full(len(obs), "go_to"), np.full((len(obs), 2), 0.9)


def declared(skills=None, env=Point, **how) -> sw.Hierarchy:
    """A small hierarchy of a skill with goals under a rule."""
    defaults = {"selector": far_corner, "algorithm": ON, "learn": "apart", "call_steps": 8}
    defaults |= {"steps": 200}
    # By default the number of processes depends on the time that a step takes, and so do weights.
    spec = env if isinstance(env, sw.EnvSpec) else sw.EnvSpec(env, workers=1)
    return sw.Hierarchy(spec, [go_to()] if skills is None else skills, **(defaults | how))


def walk(self, obs, goal):
    """Go to a goal that is a box, straight."""
    return np.clip(5 * (aim_of(goal) - place_of(obs)), -1, 1).astype(np.float32)


def rests(obs):
    """A selector that never calls a skill with goals."""
    return np.full(len(obs), "rest")


def ready(space: str = "box", **how) -> sw.Run:
    """A run of a ready skill with goals, and one without."""
    skills = [go_to(space, policy=walk), Rest()]
    return declared(skills, **({"selector": rests} | how)).train(quiet=True)
