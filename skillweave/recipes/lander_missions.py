"""Lander missions: visit points, hover, land, in the order that a mission says.

LunarLander-v3 with a mission of up to three legs: visit a box on the left, one on the right, hover
in a box for two seconds, land on the pad. A leg pays its share of 1 when it is done, and nothing
else pays. Four skills are learnt once, each by a reward of its own that knows nothing of missions;
a selector learns for each mission when to call which.

Observations: LunarLander's (0 to 7); what is still to be done, leg by leg, each one-hot of left,
right, hover, land (8 to 19); which share of the two seconds it has hovered (20).

    skillweave train lander-missions

Needs box2d: ``pip install 'skillweave[box2d]'``; with EnvPool it trains several times as fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave import PPO, Array, Hierarchy, Network, Skill, SkillweaveError, Step
from skillweave.recipes._missions import KINDS, POINTS, spec

X, Y, VX, VY, ANGLE, SPIN, LEGS = 0, 1, 2, 3, 4, 5, slice(6, 8)
LEG = slice(8, 12)
"""The leg that is flown now, one-hot."""
MISSIONS: dict[str, tuple[tuple[str, ...], ...]] = {
    "land": (("land",),),
    "hover": (("hover", "land"),),
    "tour": (("left", "right", "land"),),
}
OTHERS = (
    ("left", "land"),
    ("right", "land"),
    ("right", "left", "land"),
    ("left", "hover", "land"),
    ("right", "hover", "land"),
    ("hover", "left", "land"),
    ("hover", "right", "land"),
)
MISSIONS["any"] = (*(m for found in MISSIONS.values() for m in found), *OTHERS)
"""Each episode has another mission: what skills are learnt on."""


def error(obs: Array, point: Array) -> Array:
    """How far it is from standing still and upright at a point, (n,)."""
    far = np.hypot(obs[:, X] - point[0], obs[:, Y] - point[1])
    moving = np.hypot(obs[:, VX], obs[:, VY]) + np.abs(obs[:, ANGLE]) + 0.3 * np.abs(obs[:, SPIN])
    found: Array = far + 0.5 * moving
    return found


def rested(step: Step) -> Array:
    """It has come to rest on both legs, (N,) bool."""
    still = np.hypot(step.next_obs[:, VX], step.next_obs[:, VY]) < 1e-3
    on_legs: Array = (step.next_obs[:, LEGS] > 0).all(axis=1) & still
    return step.terminated & on_legs


class GoLeft(Skill):
    """Fly to the point on the left, until it is reached."""

    max_steps = 200
    point = POINTS[KINDS.index("left")]

    def reward(self, step: Step) -> Array:
        """Progress; 5 for being there, and −10 for the end of an episode."""
        progress = error(step.obs, self.point) - error(step.next_obs, self.point)
        reward = 10.0 * progress - 0.02 + 5.0 * self.success(step)
        return np.where(step.terminated, -10.0, reward)

    def success(self, step: Step) -> Array:
        """It is there, and slow."""
        there: Array = (error(step.next_obs, self.point) < 0.25) & ~step.terminated
        return there

    def termination(self, step: Step) -> Array:
        """It is there, and slow."""
        return self.success(step)


class GoRight(GoLeft):
    """Fly to the point on the right, until it is reached."""

    point = POINTS[KINDS.index("right")]


class Hover(Skill):
    """Fly to the point above the pad, and stay there."""

    max_steps = 200
    call_steps = 40
    point = POINTS[KINDS.index("hover")]

    def reward(self, step: Step) -> Array:
        """Progress, and the more the nearer it is; −10 for the end of an episode."""
        now = error(step.next_obs, self.point)
        reward = 10.0 * (error(step.obs, self.point) - now) + 0.5 * np.exp(-5.0 * now)
        return np.where(step.terminated, -10.0, reward)

    def success(self, step: Step) -> Array:
        """It is near the point, and slow."""
        there: Array = (error(step.next_obs, self.point) < 0.25) & ~step.terminated
        return there


class Land(Skill):
    """Come to rest on the pad, from wherever it is."""

    max_steps = 400
    point = np.zeros(2)

    def reward(self, step: Step) -> Array:
        """Progress to the pad, 1 for each leg that touches it, ±10 for how it ends."""
        progress = error(step.obs, self.point) - error(step.next_obs, self.point)
        legs = (step.next_obs[:, LEGS] - step.obs[:, LEGS]).sum(axis=1)
        reward = 10.0 * progress + legs - 0.02
        return np.where(step.terminated, np.where(rested(step), 10.0, -10.0), reward)

    def success(self, step: Step) -> Array:
        """It has come to rest on the pad."""
        on_pad: Array = rested(step) & (np.abs(step.next_obs[:, X]) <= 0.2)
        return on_pad


LEARNER = PPO(
    learning_rate=1.5e-3,
    gamma=0.99,
    gae_lambda=0.95,
    batch_size=1024,
    network=Network(activation="relu"),
)
SELECTOR = replace(
    LEARNER, gamma=0.999, gae_lambda=0.95, n_steps=128, batch_size=256, update_epochs=8
)
SKILLS = (Hover, GoLeft, GoRight, Land)


def environment(mission: str = "any", gusts: bool = False) -> Any:
    """The landers with a mission, by its name.

    Raises:
        SkillweaveError: there is none of this name.
    """
    if mission not in MISSIONS:
        raise SkillweaveError(f"no mission {mission!r}; there are: {', '.join(MISSIONS)}")
    return spec(mission + (" in gusts" if gusts else ""), MISSIONS[mission], gusts)


def declare(mission: str = "any", gusts: bool = False, **how: Any) -> Hierarchy:
    """The hierarchy on a mission; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "call_steps": None,
        "start_calls": 3,
        "algorithm": LEARNER,
        "selector": SELECTOR,
        "skill_steps": 300_000,
        "selector_steps": 200_000,
    } | how
    found = Hierarchy(environment(mission, gusts), [s() for s in SKILLS], **settings)
    found.skill("land").steps = 800_000
    return found


def with_skills(
    mission: str, skills: Mapping[str, Any], gusts: bool = False, **how: Any
) -> Hierarchy:
    """The hierarchy on a mission with skills that are there already, by name."""
    found = declare(mission, gusts, **how)
    for skill in found.skills:
        skill.policy = skills[skill.name]
    return found


def by_leg(obs: Array) -> Array:
    """The skill of the leg that is flown now, (N,) by name: the selector as one would write it."""
    names = np.array(["go_left", "go_right", "hover", "land"])
    named: Array = names[obs[:, LEG].argmax(axis=1)]
    return named


hierarchy = declare()
