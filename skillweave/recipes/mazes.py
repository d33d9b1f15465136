"""Mazes: a ball finds its goal; north, east, south, west, approach, and a selector.

PointMaze of Gymnasium-Robotics with the sparse reward: 1 where the goal is reached, and the episode
ends there. Ball and goal begin in any two cells. Skills are learnt once, in the large maze; they
see no walls, and not where they are, so that they serve every maze. A selector learns each maze.

With the shipped weights the selector hardly ever calls ``approach``: the four directions end near
enough to the goal by themselves. It stays as an example of a skill that may start in few places.

Observations: place east and north in metres (0, 1), speed (2, 3), the goal's place (4, 5).

    skillweave train mazes

Needs gymnasium-robotics: ``pip install 'skillweave[robotics]'``; with EnvPool it trains several
times as fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave import PPO, Apart, Hierarchy, Network, Selection, Skill, Step, TrainDefaults
from skillweave.algorithms import register_encoder
from skillweave.recipes._mazes import GOAL, PLACE, SPEED, spec
from skillweave.recipes._specs import given
from skillweave.types import Array

SLOW = 0.3
"""Metres a second, below which the ball counts as slow."""
GAIN = 0.1
"""Metres a second that a free ball gains at least in each step."""
TRY = 5
"""Steps for which a call tries at least, also at a wall."""


class North(Skill):
    """Roll north, as fast as the ball can, and not sideways; until a wall is in the way."""

    way = np.array([0.0, 1.0])
    max_steps = 100

    def reward(self, step: Step) -> Array:
        """Return metres a second this way, less those across."""
        speed = step.next_obs[:, SPEED]
        along = speed @ self.way
        across = np.abs(speed @ self.way[::-1])
        reward: Array = along - across
        return reward

    def termination(self, step: Step) -> Array:
        """Return whether it is stuck: slow, and no faster than before."""
        before, after = step.obs[:, SPEED] @ self.way, step.next_obs[:, SPEED] @ self.way
        blocked: Array = (after < SLOW) & (after - before < GAIN)
        return blocked & (step.elapsed >= TRY)


class East(North):
    """Roll east."""

    way = np.array([1.0, 0.0])


class South(North):
    """Roll south."""

    way = np.array([0.0, -1.0])


class West(North):
    """Roll west."""

    way = np.array([-1.0, 0.0])


def distance(obs: Array) -> Array:
    """Return metres to the goal as a bird flies, (n,)."""
    metres: Array = np.hypot(*(obs[:, GOAL] - obs[:, PLACE]).T)
    return metres


class Approach(Skill):
    """Roll straight to the goal, from near it."""

    near = 2.0
    max_steps = 50
    steps = 100_000  # most of them lead to a place where it may start

    def initiation(self, obs: Array) -> Array:
        """Return whether the goal is near, as the bird flies.

        From anywhere it would be the easy way to every goal that no wall hides, and selectors
        learnt no other skill.
        """
        return distance(obs) < self.near

    def reward(self, step: Step) -> Array:
        """Return metres by which the goal is nearer now, a hundredfold: metres a second."""
        return 100.0 * (distance(step.obs) - distance(step.next_obs)) + 100.0 * self.success(step)

    def success(self, step: Step) -> Array:
        """Return whether it is there."""
        return step.terminated


class Motion:
    """An encoder without parameters: the speed, and where the goal is from here."""

    size = 4

    def __init__(self, obs: Any) -> None:
        self.shapes: dict[str, tuple[int, ...]] = {}

    def init_(self, views: Any, generators: Any) -> None:
        """Fill no weights: it has none."""

    def __call__(self, views: Any, inputs: Mapping[str, Any]) -> Any:
        """Map (P, B, 6) to (P, B, 4)."""
        import torch

        seen = inputs["vector"]
        return torch.cat([seen[..., SPEED], seen[..., GOAL] - seen[..., PLACE]], -1)


class Map:
    """An encoder without parameters: place and goal on a grid of points a metre apart.

    Each point has a number, 1 where the ball is there, and falling to 0 within a metre, eastwards
    and northwards; so do the points for the goal. Then the speed, and where the goal is from here.
    """

    east, north = 6, 5
    """Metres from the middle to the last points."""

    def __init__(self, obs: Any) -> None:
        self.shapes: dict[str, tuple[int, ...]] = {}
        self.size = 2 * (2 * self.east + 1) * (2 * self.north + 1) + Motion.size

    def init_(self, views: Any, generators: Any) -> None:
        """Fill no weights: it has none."""

    def __call__(self, views: Any, inputs: Mapping[str, Any]) -> Any:
        """Map (P, B, 6) to (P, B, size)."""
        import torch

        seen = inputs["vector"]
        speed = seen[..., SPEED]
        way = seen[..., GOAL] - seen[..., PLACE]
        points = self._points(torch.stack([seen[..., PLACE], seen[..., GOAL]], -2))
        return torch.cat([points, 0.2 * speed, 0.2 * way], -1)

    def _points(self, places: Any) -> Any:
        """Map two places (P, B, 2, 2) to their features on the grid, one after the other."""
        import torch

        east, north = (
            torch.relu(1.0 - (places[..., i, None] - torch.arange(-n, n + 1)).abs())
            for i, n in enumerate((self.east, self.north))
        )
        return (east[..., :, None] * north[..., None, :]).flatten(-3)


register_encoder("motion in a maze", Motion)
register_encoder("map of a maze", Map)

MAP = Network(hidden=(128, 128), activation="relu", encoder="map of a maze")
BALL = PPO(
    learning_rate=1e-3,
    min_advantage_std=0.0,  # the figures were measured with it
    num_envs=32,
    n_steps=32,
    batch_size=128,
    update_epochs=8,
    gamma=0.95,
    gae_lambda=0.9,
    ent_coef=0.0,
    normalize_obs=False,
    network=Network(hidden=(32, 32), activation="relu", encoder="motion in a maze"),
)
SELECTOR = PPO(
    learning_rate=1e-3,
    min_advantage_std=0.0,  # the figures were measured with it
    num_envs=32,
    n_steps=256,
    batch_size=128,
    update_epochs=10,
    gamma=0.997,
    gae_lambda=0.95,
    ent_coef=0.03,
    ent_coef_final=0.005,
    normalize_obs=False,
    network=MAP,
)
FURTHER_SELECTOR = replace(SELECTOR, num_envs=16, batch_size=64, update_epochs=8)
"""For fewer steps: fewer environments, so that it learns as often."""
FLAT = replace(BALL, gamma=0.997, gae_lambda=0.95, ent_coef=0.003, network=MAP)
"""The flat agent sees what the selector sees; the goal is hundreds of steps away."""
SAMPLING = Selection(greedy_selector=False)
"""A greedy selector calls the same skill at the same wall again and again; one that samples gets
away from it."""
SKILLS = (North, East, South, West, Approach)


def declare(maze: str = "large", **how: Any) -> Hierarchy:
    """Return the hierarchy on a maze; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "call_steps": 25,
        "algorithm": BALL,
        "selector": SELECTOR,
        "learn": "apart",
        "apart": Apart(skill_steps=30_000, selector_steps=768_000),
        "selection": SAMPLING,
        "train_defaults": TrainDefaults(flat=FLAT),
    } | how
    return Hierarchy(spec(maze), [s() for s in SKILLS], **settings)


def with_skills(maze: str, skills: Mapping[str, Any], **how: Any) -> Hierarchy:
    """Return the hierarchy on a maze with skills that are there already, by name."""
    settings = {"selector": FURTHER_SELECTOR, "apart": Apart(selector_steps=200_000)} | how
    return given(declare(maze, **settings), skills)


hierarchy = declare()
