"""Shuttle: a half-cheetah runs to and fro between points; forward, backward, stop, and a selector.

The task is the first of the half-cheetah tasks of Toro Icarte et al. 2022, "Reward Machines":
run to x > 2, then to x < −2, and so on, for 1,000 steps. A finished round pays 1000; every other
step costs 0.1·‖action‖². Their scores are returns divided by 1,000, and so are ours
(``UNIT``): a round counts about 1, so 8.31 (their best median after 3M steps) are about nine.

Observations: x, z and the angles (0 to 8), their velocities (9 to 17), the leg of the patrol that
is run now, one-hot (18 to 20; the paper's task has two legs, so the last number is always 0).

    skillweave train shuttle

Needs mujoco: ``pip install 'skillweave[mujoco]'``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import (
    PPO,
    Array,
    Automaton,
    EnvSpec,
    Hierarchy,
    Network,
    Skill,
    SkillweaveError,
    Step,
    Together,
)

UNIT = 1000.0
"""A score is a return divided by this: the mean reward of a step."""
ROUND = 1000.0
"""What a finished round pays."""
LEGS = 3
"""The most points that a patrol has."""
ARRIVAL, HASTE = 300.0, 40.0
"""What the end of a leg is worth to a skill, and what is taken off for each metre a second at which
it is passed. A call ends there, and its value: who were not paid for it would rather not arrive.
Who passes a point at full speed runs on for four metres more."""
SECONDS = 0.05
"""Of a step."""
X, SPEED, LEG = 0, 9, slice(18, 21)


class Patrol(gym.Wrapper[Any, Any, Any, Any]):
    """Visits points in their order, over and over.

    A point is visited when it is passed, in the direction in which it lies from the point before.

    Args:
        env: a half-cheetah whose observations begin with x.
        points: two or three, in metres; each differs from the one before.

    Raises:
        SkillweaveError: there are too few or too many points, or one is followed by itself.
    """

    def __init__(self, env: gym.Env[Any, Any], points: tuple[float, ...] = (2.0, -2.0)) -> None:
        super().__init__(env)
        ways = np.sign(np.subtract(points, np.roll(points, 1)))
        if not 2 <= len(points) <= LEGS or not ways.all():
            raise SkillweaveError(
                f"a patrol has 2 to {LEGS} points, each other than the one before, not {points}"
            )
        self.points, self.ways = points, ways
        size = env.observation_space.shape[0] + LEGS  # type: ignore[index]
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.leg = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin with the first point."""
        obs, info = self.env.reset(seed=seed, options=options)
        self.leg = 0
        return self._with_leg(obs), info

    def step(self, action: Any) -> Any:
        """The automaton's reward: 1000 where a round is finished, else what the action costs."""
        obs, _, terminated, truncated, info = self.env.step(action)
        reward = float(info["reward_ctrl"])
        if self.ways[self.leg] * (info["x_position"] - self.points[self.leg]) > 0:
            self.leg = (self.leg + 1) % len(self.points)
            reward = reward if self.leg else ROUND
        return self._with_leg(obs), reward, terminated, truncated, info

    def _with_leg(self, obs: Any) -> Array:
        found = np.zeros(len(obs) + LEGS, np.float32)
        found[: len(obs)] = obs
        found[len(obs) + self.leg] = 1.0
        return found


def make(
    points: tuple[float, ...] = (2.0, -2.0), render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """The half-cheetah with this patrol.

    Raises:
        SkillweaveError: mujoco is missing.
    """
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise SkillweaveError(
            "the half-cheetah needs the extra 'mujoco': pip install 'skillweave[mujoco]'"
        ) from error
    cheetah = gym.make(
        "HalfCheetah-v5",
        exclude_current_positions_from_observation=False,
        render_mode=render_mode,
        disable_env_checker=True,
    )
    return Patrol(cheetah, points)


def moved(step: Step) -> Array:
    """Metres a second, (N,)."""
    speed: Array = (step.next_obs[:, X] - step.obs[:, X]) / SECONDS
    return speed


def effort(step: Step) -> Array:
    """What the action costs, (N,): 0.1·‖action‖²."""
    cost: Array = 0.1 * np.square(step.action).sum(axis=1)
    return cost


def arrived(step: Step) -> Array:
    """The leg of the patrol is done, (N,) bool."""
    done: Array = (step.next_obs[:, LEG] != step.obs[:, LEG]).any(axis=1)
    return done


class Forward(Skill):
    """Run forwards, until the leg of the patrol is done."""

    way = 1.0

    def reward(self, step: Step) -> Array:
        """The speed, less the effort; and for the end of a leg a prize, the slower the higher."""
        speed = self.way * moved(step)
        return speed - effort(step) + arrived(step) * (ARRIVAL - HASTE * np.abs(speed))

    def termination(self, step: Step) -> Array:
        """The leg is done."""
        return arrived(step)

    def success(self, step: Step) -> Array:
        """The leg is done."""
        return arrived(step)


class Backward(Forward):
    """Run backwards, until the leg of the patrol is done."""

    way = -1.0


class Stop(Skill):
    """Stand still."""

    max_steps = 20

    def initiation(self, obs: Array) -> Array:
        """Where it moves: who stands has nothing to do."""
        return np.abs(obs[:, SPEED]) > 1.0

    def reward(self, step: Step) -> Array:
        """As little speed as possible."""
        return -np.abs(moved(step)) - effort(step)


RELU = Network(hidden=(64, 64), activation="relu")  # tanh costs more than all the rest of it
RUNNER = PPO(
    num_envs=64,
    n_steps=64,
    batch_size=256,
    update_epochs=8,
    learning_rate=7e-4,
    gamma=0.98,
    gae_lambda=0.92,
    ent_coef=0.0,
    network=RELU,
)
SELECTOR = PPO(num_envs=64, n_steps=64, batch_size=128, gamma=0.995, gae_lambda=0.95, network=RELU)


def spec(points: tuple[float, ...] = (2.0, -2.0)) -> EnvSpec:
    """The half-cheetah with a patrol of these points, for ``Hierarchy(env=...)``."""

    def cheetah(render_mode: str | None = None) -> gym.Env[Any, Any]:
        return make(points, render_mode)

    cheetah.__name__ = f"Shuttle({', '.join(f'{p:g}' for p in points)})"
    return EnvSpec(cheetah)


def declare(points: tuple[float, ...] = (2.0, -2.0), **how: Any) -> Hierarchy:
    """The hierarchy on a patrol; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "call_steps": 40,
        "learn": "together",
        "together_steps": 3_000_000,
        # At first nearly all calls are drawn by lot: the selector knows no reward yet but what
        # effort costs, and would stand still, and skills learn to turn where others have run.
        "together": Together(floor=0.95, floor_final=0.0),
        "algorithm": RUNNER,
        "selector": SELECTOR,
    } | how
    return Hierarchy(spec(points), [Forward(), Backward(), Stop()], **settings)


def with_skills(points: tuple[float, ...], skills: Mapping[str, Any], **how: Any) -> Hierarchy:
    """The hierarchy on a patrol with skills that are there already, by name."""
    found = declare(points, **{"learn": "apart"} | how)
    for skill in found.skills:
        skill.policy = skills[skill.name]
    return found


def by_automaton(points: tuple[float, ...], skills: Mapping[str, Any]) -> Hierarchy:
    """The same skills under the task's own automaton: each leg is run in its direction."""
    ways, legs = np.sign(np.subtract(points, np.roll(points, 1))), range(len(points))
    states = {f"leg {i}": "forward" if ways[i] > 0 else "backward" for i in legs}
    transitions = {
        (f"leg {i}", f"leg {j}"): partial(on_leg, j)
        for i, j in zip(legs, np.roll(legs, -1), strict=True)
    }
    automaton = Automaton(states=states, transitions=transitions)
    return with_skills(points, skills, selector=automaton, call_steps=1)


def on_leg(leg: int, step: Step) -> Array:
    """This leg is run now, (N,) bool."""
    there: Array = step.next_obs[:, LEG][:, leg] == 1.0
    return there


hierarchy = declare()
