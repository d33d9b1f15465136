"""Lander missions: visit points, hover, land, in a mission's order.

LunarLander-v3 with a mission of up to three legs: visit a box on the left, one on the right, hover
in a box for two seconds, land on the pad. A leg pays its share of 1 when it is done, and nothing
else pays. Four skills are learnt once, each by a reward of its own that is independent of missions;
a selector learns for each mission when to call which.

Observations: LunarLander's (0 to 7); the remaining legs, each one-hot of left, right, hover, land
(8 to 19); the share of the two seconds for which it has hovered (20).

    skillweave train lander-missions

Needs box2d: ``pip install 'skillweave[box2d]'``; with EnvPool it trains several times as fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave import PPO, Apart, Hierarchy, Network, Selection, Skill, Step, TrainDefaults
from skillweave.errors import DeclarationError
from skillweave.recipes._missions import HALF, HOVER, KINDS, LEFT, PAD, POINTS, RIGHT, spec
from skillweave.recipes._specs import given
from skillweave.types import Array

X = 0
Y = 1
VX = 2
VY = 3
ANGLE = 4
SPIN = 5
LEGS = slice(6, 8)
TO_DO = slice(8, 20)
"""The legs that are still to be done, in their order, each one-hot."""
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
"""Missions for skills' training: each episode has another one."""


CRASH = -20.0
"""Reward of the end of an episode in a flight."""


def rested(step: Step) -> Array:
    """Return whether it has come to rest, (N,) bool: LunarLander's physics sets its speed to 0."""
    still: Array = (step.next_obs[:, [VX, VY]] == 0.0).all(axis=1)
    return step.terminated & still


class Flight(Skill):
    """Fly at the speed that is wanted where it is, upright."""

    max_steps = 300
    prize = 300.0
    """Reward for the point, where a call ends there. Flight forever is worth up to 200, as a step
    pays up to 1 and γ is 0.995: with a smaller prize a skill delays its end."""
    point: Array
    half: Array
    """Half the width and height of the box around the point: the leg's own, as a call that ended
    outside it would be called again, and end again, forever."""

    def wanted(self, obs: Array) -> Array:
        """Return speeds, (n, 2): towards the point, the slower the nearer."""
        way = (self.point - obs[:, [X, Y]]) * (2.5, 1.0)
        speed: Array = np.clip(way, (-1.0, -0.5), (1.0, 0.5))
        return speed

    def deviation(self, obs: Array) -> Array:
        """Return the deviation from that speed, from upright and from not turning, (n,)."""
        speed: Array = np.hypot(*(obs[:, [VX, VY]] - self.wanted(obs)).T)
        return speed + np.abs(obs[:, ANGLE]) + 0.3 * np.abs(obs[:, SPIN])

    def reward(self, step: Step) -> Array:
        """Return 1 less the deviation; the prize; −20 for the end of an episode."""
        reward = 1.0 - self.deviation(step.next_obs) + self.prize * self.success(step)
        return np.where(step.terminated, CRASH, reward)

    def there(self, obs: Array) -> Array:
        """Return whether it is in the box around the point, slow and upright, (n,) bool."""
        moving = np.hypot(obs[:, VX], obs[:, VY]) + np.abs(obs[:, ANGLE])
        arrived: Array = self.in_box(obs) & (moving < 0.5)
        return arrived

    def in_box(self, obs: Array) -> Array:
        """Return whether it is in the box around the point, (n,) bool."""
        inside: Array = (np.abs(obs[:, [X, Y]] - self.point) <= self.half).all(axis=1)
        return inside

    def success(self, step: Step) -> Array:
        """Return whether it is there, and flies."""
        flies: Array = self.there(step.next_obs) & ~step.terminated
        return flies


class Hover(Flight):
    """Fly to the point above the pad, and stay there."""

    call_steps = 200
    """It flies there, and stays for two seconds. With calls of 50 steps a leg took several, one
    after the other, which a selector hardly ever chose at random."""
    prize = 0.0
    point = POINTS[HOVER]
    half = HALF[HOVER]

    def reward(self, step: Step) -> Array:
        """Return 1 less the deviation, 1 for a step in the box, −20 for an episode's end."""
        # The leg requires a place. Where only its speed was paid, a skill stayed just beside it.
        in_box = self.in_box(step.next_obs) & ~step.terminated
        reward: Array = super().reward(step) + in_box
        return reward


class GoLeft(Flight):
    """Fly to the point on the left, until it is reached."""

    point = POINTS[LEFT]
    half = HALF[LEFT]

    def initiation(self, obs: Array) -> Array:
        """Return whether it is elsewhere: at the point a call would end at once."""
        return ~self.there(obs)

    termination = Flight.success


class GoRight(GoLeft):
    """Fly to the point on the right, until it is reached."""

    point = POINTS[RIGHT]
    half = HALF[RIGHT]


class Land(Skill):
    """Come to rest on the pad, from wherever it is."""

    max_steps = 400
    fuel = np.array([0.0, 0.03, 0.3, 0.03])
    """Cost of a step of each engine: none, left, main, right."""

    def worth(self, obs: Array) -> Array:
        """Return the worth of a state, (n,), by LunarLander's own reward.

        It is best near the middle of the pad, slow, upright, legs on the ground.
        """
        distance = np.hypot(obs[:, X], obs[:, Y])
        speed = np.hypot(obs[:, VX], obs[:, VY])
        legs = (obs[:, LEGS] > 0).sum(axis=1)
        worth: Array = -100.0 * (distance + speed + np.abs(obs[:, ANGLE])) + 10.0 * legs
        return worth

    def reward(self, step: Step) -> Array:
        """Return the gain in worth, less the fuel.

        Rest on the pad pays 100, any other end of the episode −100.
        """
        better = self.worth(step.next_obs) - self.worth(step.obs) - self.fuel[step.action]
        return np.where(step.terminated, np.where(self.success(step), 100.0, -100.0), better)

    def success(self, step: Step) -> Array:
        """Return whether it has come to rest on the pad."""
        on_pad: Array = rested(step) & (np.abs(step.next_obs[:, X]) <= PAD)
        return on_pad


PILOT = PPO(
    num_envs=64,
    n_steps=64,
    batch_size=256,
    update_epochs=10,
    learning_rate=1e-3,
    network=Network(sees=tuple(range(8))),
)
"""The learner of a skill. It does not see the mission: it would learn to fly well on the missions
that it meets often, and badly on the others."""
RELU = Network(activation="relu")  # tanh costs more than all the rest of so small a network
SELECTOR = PPO(
    num_envs=64,
    learning_rate=1e-3,
    min_advantage_std=0.0,  # the figures were measured with it
    n_steps=128,
    batch_size=32,  # a rollout has few decisions
    update_epochs=10,
    gamma=0.999,
    gae_lambda=0.95,
    ent_coef=0.05,
    ent_coef_final=0.0,
    network=RELU,
)
FLAT = replace(PILOT, gamma=0.999, gae_lambda=0.98, network=RELU)
"""The flat agent sees the mission. It is paid at the end of a leg only, so it looks further ahead
than a skill."""
SKILLS = (Hover, GoLeft, GoRight, Land)


def environment(mission: str = "any", gusts: bool = False) -> Any:
    """Return the landers with a mission, by its name.

    Raises:
        DeclarationError: no mission has this name.
    """
    if mission not in MISSIONS:
        raise DeclarationError(f"no mission {mission!r}; there are: {', '.join(MISSIONS)}")
    return spec(mission + (" in gusts" if gusts else ""), MISSIONS[mission], gusts)


def declare(mission: str = "any", gusts: bool = False, **how: Any) -> Hierarchy:
    """Return the hierarchy on a mission; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "call_steps": None,
        "learn": "apart",
        "apart": Apart(skill_steps=400_000, selector_steps=600_000, start_calls=2),
        # Greedy skills may stay beside their point, and never arrive.
        "selection": Selection(greedy_skills=False),
        "algorithm": PILOT,
        "selector": SELECTOR,
        "train_defaults": TrainDefaults(flat=FLAT),
        "predicates": {"left": GoLeft().success, "right": GoRight().success},
    } | how
    hierarchy = Hierarchy(environment(mission, gusts), [s() for s in SKILLS], **settings)
    hierarchy.skill("hover").steps = 300_000
    hierarchy.skill("land").steps = 1_600_000
    return hierarchy


def with_skills(
    mission: str, skills: Mapping[str, Any], gusts: bool = False, **how: Any
) -> Hierarchy:
    """Return the hierarchy on a mission with skills that are there already, by name."""
    how = {"apart": Apart(selector_steps=300_000)} | how
    return given(declare(mission, gusts, **how), skills)


def by_leg(obs: Array) -> Array:
    """Return the skill of the current leg, (N,) by name: a selector written by hand.

    Where that skill may not start, as the lander is there already, it is the next leg's skill; and
    where all is done, the lander hovers.
    """
    n = len(obs)
    skills = [GoLeft(), GoRight(), Hover(), Land()]
    may = np.stack([skill.initiation(obs) for skill in skills], axis=1)
    legs = obs[:, TO_DO].reshape(n, -1, len(KINDS)) > 0
    kinds = np.full(n, HOVER)
    for leg in reversed(range(legs.shape[1])):
        kind = legs[:, leg].argmax(axis=1)
        able = legs[:, leg].any(axis=1) & may[np.arange(n), kind]
        kinds = np.where(able, kind, kinds)
    named: Array = np.array([skill.name for skill in skills])[kinds]
    return named


hierarchy = declare()
