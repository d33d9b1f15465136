"""LunarLander-v3 with sub-tasks of our own: approach, brake, touchdown, and a selector.

Observations: x, y, vx, vy, angle, angular velocity, left leg, right leg. Rewards are in tenths
of the environment's points; none is the environment's own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skillweave import (
    PPO,
    Apart,
    Array,
    Hierarchy,
    Network,
    Skill,
    Step,
)

X, Y, VX, VY, ANGLE, SPIN = 0, 1, 2, 3, 4, 5
MAIN_ENGINE = 2


def nearness(obs: Array, height: float) -> Array:
    """Minus the distance to the point above the pad, the speed and the tilt, (N,)."""
    distance = np.hypot(obs[:, X], obs[:, Y] - height)
    speed = np.hypot(obs[:, VX], obs[:, VY])
    score: Array = -10.0 * (distance + speed + np.abs(obs[:, ANGLE]))
    return score


def fuel(step: Step) -> Array:
    """What the engines burnt, in tenths of points."""
    return np.where(step.action == MAIN_ENGINE, 0.03, np.where(step.action == 0, 0.0, 0.003))


class Approach(Skill):
    """Fly to a standstill a little above the pad, quickly and with little fuel."""

    max_steps = 250
    height = 0.3

    def reward(self, step: Step) -> Array:
        """Progress towards the point above the pad, less fuel and time; −10 for an end."""
        progress = nearness(step.next_obs, self.height) - nearness(step.obs, self.height)
        reward = progress - fuel(step) - 0.02 + 2.0 * self.success(step)
        return np.where(step.terminated, -10.0, reward)

    def success(self, step: Step) -> Array:
        """Within 0.15 of the point, and slow."""
        near: Array = nearness(step.next_obs, self.height) > -3.0
        return near

    def termination(self, step: Step) -> Array:
        """There is nothing more to approach."""
        return self.success(step)


class Brake(Skill):
    """Sink upright, slower the lower: 0.1 and half the height a second."""

    max_steps = 250

    def reward(self, step: Step) -> Array:
        """1 less the errors of vertical speed, drift, tilt and spin; less fuel; −10 for an end."""
        obs = step.next_obs
        error = np.abs(obs[:, VY] + 0.1 + 0.5 * np.maximum(obs[:, Y], 0.0))
        error = error + np.abs(obs[:, VX]) + np.abs(obs[:, ANGLE]) + 0.3 * np.abs(obs[:, SPIN])
        reward = 1.0 - np.minimum(2.0 * error, 2.0) - fuel(step)
        crashed = step.terminated & (step.reward < 0)
        return np.where(crashed, -10.0, reward)


class Touchdown(Skill):
    """Come to rest on the pad, soon and upright, whatever the fuel."""

    max_steps = 300

    def reward(self, step: Step) -> Array:
        """Progress towards the pad, 1 for each leg that touches it, ±10 for how it ends."""
        progress = nearness(step.next_obs, 0.0) - nearness(step.obs, 0.0)
        legs = (step.next_obs[:, 6:] - step.obs[:, 6:]).sum(axis=1)
        ending = np.where(step.terminated, np.where(step.reward > 0, 10.0, -10.0), 0.0)
        reward: Array = progress + legs + ending - 0.02
        return reward

    def success(self, step: Step) -> Array:
        """At rest."""
        rested: Array = step.terminated & (step.reward > 0)
        return rested


LEARNER = PPO(
    learning_rate=1.5e-3,
    gamma=0.995,
    gae_lambda=0.97,
    batch_size=1024,
    update_epochs=4,
    network=Network(activation="relu"),
)

hierarchy = Hierarchy(
    env="LunarLander-v3",
    skills=[Approach(), Brake(), Touchdown()],
    call_steps=8,
    algorithm=LEARNER,
    selector=replace(LEARNER, gamma=0.999, gae_lambda=0.98, n_steps=256, normalize_obs=False),
    learn="apart",
    apart=Apart(skill_steps=400_000, selector_steps=800_000),
)
hierarchy.skill("touchdown").steps = 1_600_000
