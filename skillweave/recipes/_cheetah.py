"""The half-cheetah of ``shuttle``: its task, alone and in EnvPool."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import EnvSpec
from skillweave.envs import PoolWrapper, envpool
from skillweave.errors import DeclarationError, needs_extra
from skillweave.recipes._specs import OwnTask, named
from skillweave.types import Array

ROUND = 1000.0
"""Reward of a finished round."""
LEGS = 3
"""The most points that a patrol has."""
WITH_X: Any = {"exclude_current_positions_from_observation": False}
X = 0
SPEED = 9
LEG = slice(18, 21)


class Route:
    """The points of a patrol, in their order, again and again: observations and rewards.

    A point is visited when the half-cheetah passes it in the direction from the point before.

    Args:
        points: two or three, in metres; each differs from the one before.

    Raises:
        DeclarationError: there are too few or too many points, or one is followed by itself.
    """

    def __init__(self, points: tuple[float, ...]) -> None:
        self.points = np.array(points)
        self.ways = np.sign(np.subtract(points, np.roll(points, 1)))
        if not 2 <= len(points) <= LEGS or not self.ways.all():
            raise DeclarationError(
                f"a patrol has 2 to {LEGS} points, each other than the one before, not {points}"
            )

    def walk(self, leg: Array, x: Array, cost: Array) -> tuple[Array, Array]:
        """Return the legs (k,) after steps to ``x``, and their rewards.

        A finished round pays 1000; any other step pays the cost of its action.
        """
        passed = self.ways[leg] * (x - self.points[leg]) > 0
        after = np.where(passed, (leg + 1) % len(self.points), leg)
        return after, np.where(passed & (after == 0), ROUND, cost)

    def see(self, obs: Array, leg: Array) -> Array:
        """Return observations (k, O) whose first number is x, with the legs (k,).

        x is relative to the next point, on a logarithmic scale.
        """
        observed = np.zeros((len(obs), obs.shape[1] + LEGS), np.float32)
        observed[:, : obs.shape[1]] = obs
        observed[:, X] = to_log(obs[:, X] - self.points[leg])
        observed[np.arange(len(obs)), obs.shape[1] + leg] = 1.0
        return observed

    @staticmethod
    def space(before: Any) -> gym.spaces.Box:
        """Return the space of the observations."""
        return gym.spaces.Box(-np.inf, np.inf, (before.shape[0] + LEGS,), np.float32)


def to_log(metres: Array) -> Array:
    """Return ``metres`` x from a point on a logarithmic scale: sign(x)·log(1 + |x|).

    In metres, x varies by about 10 (its standard deviation) while skills are chosen at random.
    With normalised observations it then hardly changes in the last two metres before the point.
    """
    scaled: Array = np.sign(metres) * np.log1p(np.abs(metres))
    return scaled


def from_log(seen: Array) -> Array:
    """Return the inverse of ``to_log``, in metres."""
    metres: Array = np.sign(seen) * np.expm1(np.abs(seen))
    return metres


class Patrol(OwnTask):
    """A half-cheetah on a route.

    Args:
        env: its observations begin with x.
    """

    def __init__(self, env: gym.Env[Any, Any], points: tuple[float, ...] = (2.0, -2.0)) -> None:
        super().__init__(env)
        self.route = Route(points)
        self.leg = np.zeros(1, np.int64)
        self.observation_space = self.route.space(env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start with the first point."""
        obs, info = self.env.reset(seed=seed, options=options)
        self.leg[:] = 0
        return self.route.see(obs[None], self.leg)[0], info

    def step(self, action: Any) -> Any:
        """Take a step; the route pays."""
        obs, _, terminated, truncated, info = self.env.step(action)
        x = np.array([info["x_position"]])
        cost = np.array([info["reward_ctrl"]])
        self.leg, reward = self.route.walk(self.leg, x, cost)
        seen = self.route.see(obs[None], self.leg)[0]
        return seen, float(reward[0]), terminated, truncated, info


class Patrols(PoolWrapper):
    """A pool of half-cheetahs on a route, as ``Patrol`` has one."""

    def __init__(self, pool: Any, num_envs: int, points: tuple[float, ...]) -> None:
        self.route = Route(points)
        self.leg = np.zeros(num_envs, np.int64)
        super().__init__(pool, self.route.space(pool.observation_space))
        self.action_space = gym.spaces.Box(-1.0, 1.0, pool.action_space.shape, np.float32)

    def see(self, obs: Any, ids: Array) -> Array:
        """Return the observations with the legs."""
        return self.route.see(obs, self.leg[ids])

    def reset(self, ids: Array) -> tuple[Any, dict[str, Any]]:
        """Start with the first point."""
        self.leg[ids] = 0
        return super().reset(ids)

    def step(self, action: Array, ids: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Take a step; the route pays."""
        obs, _, terminated, truncated, info = self.pool.step(action, ids)
        legs = self.route.walk(self.leg[ids], info["x_position"], info["reward_ctrl"])
        self.leg[ids], reward = legs
        return self.see(obs, ids), reward, terminated, truncated, info


def make(
    points: tuple[float, ...] = (2.0, -2.0), render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Return the half-cheetah with this patrol.

    Raises:
        MissingExtra: mujoco is missing.
    """
    with needs_extra("the half-cheetah", "mujoco"):
        import mujoco  # noqa: F401
    cheetah = gym.make(
        "HalfCheetah-v5",
        **WITH_X,
        render_mode=render_mode,
        disable_env_checker=True,
        camera_id=-1,  # one that stands still, not the model's own, which follows
        default_camera_config=camera(points),
        width=640,
        height=240,
    )
    return Patrol(cheetah, points)


def camera(points: tuple[float, ...]) -> dict[str, Any]:
    """Return a camera whose picture has all points, and some metres beyond."""
    near, far = min(points), max(points)
    middle = np.array([(near + far) / 2.0, 0.0, 0.3])
    return {"distance": 1.5 + (far - near) / 2.0, "lookat": middle, "elevation": -8.0}


def many(num_envs: int, threads: int, seed: int, points: tuple[float, ...]) -> Patrols:
    """Make the patrols in EnvPool: several times as fast, with the same dynamics bit for bit."""
    cheetahs = envpool("HalfCheetah-v5", num_envs, threads, seed, **WITH_X)
    return Patrols(cheetahs, num_envs, points)


def spec(points: tuple[float, ...] = (2.0, -2.0)) -> EnvSpec:
    """Return the half-cheetah with a patrol of these points, for ``Hierarchy(env=...)``."""
    # The name has the scale of x, so that runs with another scale are not taken for these.
    name = f"Shuttle({', '.join(f'{p:g}' for p in points)}; log x)"
    return named(name, partial(make, points), partial(many, points=points))
