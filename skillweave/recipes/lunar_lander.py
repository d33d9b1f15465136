"""The tutorial's hierarchy on LunarLander-v3: stabilize, center, landing, and a selector.

Observations: x, y, vx, vy, angle, angular velocity, left leg, right leg.

The tutorial also pays 10 in a skill's 300th step, for lasting. Observations do not hold the time,
so a critic cannot foresee such a reward, and here the value goes on beyond a time limit: the 10
would only be noise. Without it stabilize and center hold as well as with it.

With the shipped weights the selector never calls ``stabilize``. LunarLander pays in every step on
the way to the pad, so one skill can learn nearly all of the task: ``landing`` acts in four fifths
of the steps, ``center`` in the rest. A flat agent lands as well (``skillweave demo``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skillweave import (
    PPO,
    Apart,
    Hierarchy,
    Network,
    Reflex,
    Selection,
    Skill,
    Step,
    Together,
    TrainDefaults,
)
from skillweave.types import Array

X = 0
Y = 1
ANGLE = 4
LEFT_LEG = 6
RIGHT_LEG = 7


def movement(step: Step, *columns: int) -> Array:
    """Return ``Σ (10·Δ)²`` over the columns; 0 on the first step, which has no step before it."""
    moved = step.next_obs[:, columns] - step.obs[:, columns]
    return np.where(step.elapsed > 1, np.square(10.0 * moved).sum(axis=1), 0.0)


class Stabilize(Skill):
    """Stand still in the air: as little movement as possible."""

    max_steps = 300

    def reward(self, step: Step) -> Array:
        """Return 1 less the movement in x, y and angle; −100 for an episode's end."""
        reward = 1.0 - movement(step, X, Y, ANGLE)
        return np.where(step.terminated | step.truncated, -100.0, reward)


class Center(Skill):
    """Go to the middle, x = 0, and stay there."""

    max_steps = 300

    def reward(self, step: Step) -> Array:
        """Return 1 less (2x)² and the movement in y and angle; −1000 for an episode's end."""
        reward = 1.0 - np.square(2.0 * step.next_obs[:, X]) - movement(step, Y, ANGLE)
        return np.where(step.terminated | step.truncated, -1000.0, reward)


class Landing(Skill):
    """Go down onto the pad at the origin."""

    # The tutorial's landing lasts as long as its episode. Cut here like the other two (its value
    # is bootstrapped, so what is optimal stays so), training sees more descents than hovering.
    max_steps = 300

    def reward(self, step: Step) -> Array:
        """Return 1 less x², y² and the angle; at an episode's end the environment's own reward."""
        obs = step.next_obs
        reward = 1.0 - np.square(obs[:, X]) - np.square(obs[:, Y]) - np.abs(obs[:, ANGLE])
        return np.where(step.terminated | step.truncated, step.reward, reward)


def landed(obs: Array) -> Array:
    """Return whether a leg touches the ground."""
    touching: Array = (obs[:, LEFT_LEG] > 0) | (obs[:, RIGHT_LEG] > 0)
    return touching


RELU = Network(activation="relu")  # tanh costs more than all the rest of so small a network

HOLDING = PPO(
    num_envs=64,
    n_steps=64,
    learning_rate=1e-3,
    gamma=0.98,
    gae_lambda=0.95,
    batch_size=1024,
    update_epochs=3,
    network=RELU,
)
# A landing is worth more than hovering forever (+100 once against +1 a step) only where γ is well
# below 0.99, and only to an agent that can already touch the ground without crashing:
# hence more exploration at first, and most of the steps that skills have to themselves.
LANDING = replace(HOLDING, learning_rate=3e-3, ent_coef=0.02, ent_coef_final=0.002)
SELECTOR = PPO(
    num_envs=256,  # fewer, longer steps of the engine: acting costs nearly the same for all
    n_steps=40,  # 4 calls
    learning_rate=2e-3,
    batch_size=512,
    update_epochs=4,
    gamma=0.999,
    gae_lambda=0.98,
    normalize_obs=False,
    network=RELU,
)
FLAT = PPO(
    num_envs=64,
    n_steps=64,
    batch_size=256,
    learning_rate=1e-3,
    gamma=0.999,
    gae_lambda=0.98,
    update_epochs=4,
    network=RELU,
)

hierarchy = Hierarchy(
    env="LunarLander-v3",
    skills=[Stabilize(), Center(), Landing()],
    call_steps=10,
    reflexes=[Reflex(landed, action=0, name="engines off")],
    algorithm=HOLDING,
    selector=SELECTOR,
    learn="apart, then together",
    apart=Apart(skill_steps=10_000, selector_steps=50_000),
    # Most of the steps are together: the task's advantage teaches skills more than their rewards.
    together=Together(
        steps=1_500_000, task_weight=100.0, reference_kl=None, epsilon=0.3, epsilon_final=0.02
    ),
    selection=Selection(greedy_skills=False),  # greedy skills scored less
    train_defaults=TrainDefaults(flat=FLAT),
)
hierarchy.skill("landing").algorithm = LANDING
hierarchy.skill("landing").steps = 50_000
