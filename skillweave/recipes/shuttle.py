"""Shuttle: a half-cheetah runs to and fro between points; forward, backward, stop, and a selector.

The task is the first of the half-cheetah tasks of Toro Icarte et al. 2022, "Reward Machines":
run to x > 2, then to x < −2, and so on, for 1,000 steps. A finished round pays 1000; every other
step costs 0.1·‖action‖². Their scores are returns divided by 1,000, and so are ours
(``UNIT``): a round counts about 1, so 8.31 (their best median after 3M steps) are about nine.

Observations: x on a logarithmic scale (0: sign(d)·log(1 + |d|), where d = x − the point that is run
to, so that skills serve other points, too), z and the angles (1 to 8), velocities (9 to 17), the
leg of the patrol that is run now, one-hot (18 to 20; the paper's task has two legs, so the last
number is always 0). The selector sees all of it, skills all but the leg.

With the shipped weights the selector never calls ``stop``: ``forward`` and ``backward`` brake
before a point by themselves, as their reward is higher the slower they pass it. It
stays as an example of a skill that a selector leaves alone, as the task does not need it.

    skillweave train shuttle

Needs mujoco: ``pip install 'skillweave[mujoco]'``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from skillweave import PPO, Automaton, Hierarchy, Network, Skill, Step, Together
from skillweave.recipes._cheetah import LEG, SPEED, spec
from skillweave.recipes._specs import given
from skillweave.types import Array

UNIT = 1000.0
"""A score is a return divided by this: the mean reward of a step."""
ARRIVAL = 400.0
"""A skill's reward for the end of a leg. The call ends there, and so does its return: a skill that
is not paid for arriving learns not to arrive."""
HASTE = 80.0
"""The deduction from ``ARRIVAL`` for each metre a second at the end of a leg. At five metres a
second, about the highest speed, the half-cheetah runs on for two metres more, and nothing is paid.
With 300 and 40 for both, skills hardly braked."""


def moved(step: Step) -> Array:
    """Return metres a second, (N,)."""
    speed: Array = step.next_obs[:, SPEED]
    return speed


def effort(step: Step) -> Array:
    """Return the cost of the action, (N,): 0.1·‖action‖²."""
    cost: Array = 0.1 * np.square(step.action).sum(axis=1)
    return cost


def arrived(step: Step) -> Array:
    """Return whether the leg of the patrol is done, (N,) bool."""
    done: Array = (step.next_obs[:, LEG] != step.obs[:, LEG]).any(axis=1)
    return done


class Forward(Skill):
    """Run forwards, until the leg of the patrol is done."""

    way = 1.0

    def reward(self, step: Step) -> Array:
        """Return the speed, less the effort, and a prize for a slow end of a leg."""
        speed = self.way * moved(step)
        return speed - effort(step) + arrived(step) * (ARRIVAL - HASTE * np.abs(speed))

    def termination(self, step: Step) -> Array:
        """Return whether the leg is done."""
        return arrived(step)

    success = termination


class Backward(Forward):
    """Run backwards, until the leg of the patrol is done."""

    way = -1.0


class Stop(Skill):
    """Stand still."""

    max_steps = 20

    def initiation(self, obs: Array) -> Array:
        """Return whether it moves: at rest there is nothing to do."""
        return np.abs(obs[:, SPEED]) > 1.0

    def reward(self, step: Step) -> Array:
        """Return less for more speed."""
        return -np.abs(moved(step)) - effort(step)


RELU = Network(hidden=(64, 64), activation="relu")  # tanh costs more than all the rest of it
RUNNER = PPO(
    min_advantage_std=0.0,  # the figures were measured with it
    num_envs=64,
    n_steps=64,
    batch_size=256,
    update_epochs=8,
    learning_rate=7e-4,
    gamma=0.98,
    gae_lambda=0.92,
    ent_coef=0.0,
    network=replace(RELU, sees=tuple(range(LEG.start))),
)
"""The learner of a skill. It does not see the leg, so that it serves patrols with other legs: with
the leg, ``backward`` would learn only those legs in which the source task runs backwards."""
SELECTOR = PPO(
    learning_rate=1e-3,
    min_advantage_std=0.0,  # the figures were measured with it
    num_envs=64,
    n_steps=64,
    batch_size=128,
    update_epochs=4,
    gamma=0.995,
    gae_lambda=0.95,
    network=RELU,
)

COLLECTORS = 2
"""Processes that step half-cheetahs and act in them, while this one learns. On two cores that takes
about four fifths of the time of a single one. What is learnt depends on their number, so it is the
same on every machine."""

# At first nearly all calls are random: the selector has met no reward yet but the costs of
# effort, and would stand still; and skills learn to turn where others have run. In the end a few
# are, so that skills keep learning to start elsewhere than the task calls them. After a
# sixth of the steps the selector has learnt its task. While calls are random, points are seldom
# passed, and that is where skills learn to brake: so the share falls fast.
TOGETHER = Together(
    steps=3_000_000, task_weight=0.0, epsilon=0.95, epsilon_final=0.05, epsilon_fraction=0.4
)

FURTHER_CALL_STEPS = 100
"""Skills that are there already end by themselves where a leg is done. Random calls of 40 steps
hardly ever run eight metres the same way; these do half of the time."""
FURTHER_SELECTOR = replace(
    SELECTOR,
    num_envs=16,
    n_steps=512,
    batch_size=64,
    update_epochs=10,
    epsilon=0.5,
    epsilon_final=0.0,
)
"""Fewer environments: a rollout holds about seven calls of each, one after another."""


def declare(points: tuple[float, ...] = (2.0, -2.0), **how: Any) -> Hierarchy:
    """Return the hierarchy on a patrol; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "call_steps": 40,
        "learn": "together",
        "together": TOGETHER,
        "algorithm": RUNNER,
        "selector": SELECTOR,
    } | how
    env = replace(spec(points), workers=COLLECTORS)
    return Hierarchy(env, [Forward(), Backward(), Stop()], **settings)


def with_skills(points: tuple[float, ...], skills: Mapping[str, Any], **how: Any) -> Hierarchy:
    """Return the hierarchy on a patrol with skills that are there already, by name."""
    settings = {
        "learn": "apart",
        "selector": FURTHER_SELECTOR,
        "call_steps": FURTHER_CALL_STEPS,
    } | how
    hierarchy = given(declare(points, **settings), skills)
    hierarchy.env = spec(points)  # sixteen environments are too few to be shared out
    return hierarchy


def by_automaton(points: tuple[float, ...], skills: Mapping[str, Any]) -> Hierarchy:
    """Return the skills under the task's own automaton: each leg is run in its direction."""
    ways = np.sign(np.subtract(points, np.roll(points, 1)))
    legs = range(len(points))
    states = {f"leg {i}": "forward" if ways[i] > 0 else "backward" for i in legs}
    transitions = {
        (f"leg {i}", f"leg {j}"): partial(on_leg, j)
        for i, j in zip(legs, np.roll(legs, -1), strict=True)
    }
    automaton = Automaton(states=states, transitions=transitions)
    return with_skills(points, skills, selector=automaton, call_steps=1)


def on_leg(leg: int, step: Step) -> Array:
    """Return whether this leg is run now, (N,) bool."""
    is_next: Array = step.next_obs[:, LEG][:, leg] == 1.0
    return is_next


hierarchy = declare()
