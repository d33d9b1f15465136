"""The robot's arm of ``pick-and-place``: its task and disturbances."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import EnvSpec
from skillweave.errors import needs_extra
from skillweave.recipes._specs import named
from skillweave.types import Array

NEAR = 0.05
"""Metres from the goal at which the block is there, as Gymnasium-Robotics has it."""
HOLD = 5
"""Steps for which the block must be there."""
CAMERA = {
    "distance": 1.2,
    "azimuth": 132.0,
    "elevation": -14.0,
    "lookat": np.array([1.3, 0.75, 0.6]),
}
"""Nearer than Gymnasium-Robotics', so that films show block and goal."""


@dataclass(frozen=True)
class Disturbances:
    """Disturbances of an episode: each happens once, in a step that is drawn at its start."""

    nudge: int = 10
    """The block is pushed in one of the first n steps in which it is free; 0: never."""
    slip: int = 10
    """The fingers open for a while in one of the first n steps in which they hold it."""
    move: int = 25
    """The goal moves to another place in one of the first n steps."""


CALM = Disturbances(0, 0, 0)


class Place(gym.Wrapper[Any, Any, Any, Any]):
    """The task: pays 1 and ends when the block has been at the goal for a while.

    Args:
        env: Gymnasium-Robotics' environment.
        disturbances: the events that disturb it.
    """

    slip_steps = 5
    """Steps for which fingers that slip are open."""
    push = 1.2
    """Speed of a block that is nudged, in metres a second; friction stops it after 5 to 10 cm."""

    def __init__(self, env: gym.Env[Any, Any], disturbances: Disturbances = CALM) -> None:
        super().__init__(env)
        self.disturbances = disturbances
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (28,), np.float32)
        self.there = self.slipping = 0
        self.due: dict[str, int] = {}
        self.holds = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start a new episode."""
        obs, info = self.env.reset(seed=seed, options=options)
        self.there = self.slipping = 0
        windows = asdict(self.disturbances)
        self.due = {
            k: int(self.env.unwrapped.np_random.integers(n)) for k, n in windows.items() if n
        }
        self.holds = False
        return _flat(obs), info

    def step(self, action: Any) -> Any:
        """Pay 1 and end the episode where the block has been at the goal for five steps."""
        self._disturb()
        if self.slipping:
            self.slipping -= 1
            action = np.append(action[:3], np.float32(1.0))
        obs, _, terminated, truncated, info = self.env.step(action)
        self.holds = bool(is_held(obs["observation"]))
        distance = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"])
        self.there = self.there + 1 if distance < NEAR else 0
        placed = self.there >= HOLD
        info["success"] = placed
        return _flat(obs), float(placed), terminated or placed, truncated and not placed, info

    def _disturb(self) -> None:
        """Let this step's disturbances happen."""
        world: Any = self.env.unwrapped
        if self.holds and self._happens("slip"):
            self.slipping = self.slip_steps
        if not self.holds and self._happens("nudge"):
            self._nudge(world)
        if self._happens("move"):
            world.goal = world._sample_goal()

    def _nudge(self, world: Any) -> None:
        """Push the block in a random direction; inwards if it is at the edge of the arm's reach."""
        angle = world.np_random.uniform(-np.pi, np.pi)
        way = np.array([np.cos(angle), np.sin(angle)])
        of = world.model, world.data
        place = world._utils.get_site_xpos(*of, "object0")
        inwards = world.initial_gripper_xpos[:2] - place[:2]
        if np.linalg.norm(inwards) > 0.12:
            way = inwards / np.linalg.norm(inwards)
        velocity = world._utils.get_joint_qvel(*of, "object0:joint").copy()
        velocity[:2] += self.push * way
        world._utils.set_joint_qvel(*of, "object0:joint", velocity)

    def _happens(self, what: str) -> bool:
        """Count down to a disturbance; return whether it happens in this step."""
        if what not in self.due:
            return False
        self.due[what] -= 1
        if self.due[what] >= 0:
            return False
        del self.due[what]
        return True


def is_held(obs: Array) -> Array:
    """Return whether closed fingers hold the block; (..., 25 or 28) to (...) bool."""
    closed = obs[..., 9:11].sum(axis=-1) < 0.053
    held: Array = closed & (np.abs(obs[..., 6:9]).max(axis=-1) < 0.03)
    return held


def _flat(obs: dict[str, Array]) -> Array:
    """Return the arm's observation and the wanted place as one array."""
    return np.concatenate([obs["observation"], obs["desired_goal"]]).astype(np.float32)


def make(disturbances: Disturbances = CALM, render_mode: str | None = None) -> gym.Env[Any, Any]:
    """Return the arm, with or without disturbances.

    Raises:
        MissingExtra: gymnasium-robotics is missing.
    """
    with needs_extra("the robot's arm", "robotics"):
        import gymnasium_robotics
        import mujoco  # noqa: F401
    gym.register_envs(gymnasium_robotics)
    arm = gym.make(
        "FetchPickAndPlace-v4",
        max_episode_steps=50 if disturbances == CALM else 100,
        render_mode=render_mode,
        disable_env_checker=True,
        default_camera_config=CAMERA,
    )
    return Place(arm, disturbances)


def spec(disturbances: Disturbances = CALM) -> EnvSpec:
    """Return the task, for ``Hierarchy(env=...)``."""
    name = "PickAndPlace" if disturbances == CALM else "PickAndPlaceDisturbed"
    return named(name, partial(make, disturbances))
