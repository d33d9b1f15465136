"""Pick and place: a robot's arm grasps a block and brings it to a goal, in spite of disturbances.

FetchPickAndPlace-v4 (Plappert et al. 2018, Gymnasium-Robotics). Four skills are functions of one
line each; a fifth, ``recover``, is learnt. A selector learns when to use which; ``rule`` and
``behaviour_tree`` choose by hand.

An episode pays 1 and ends when the block has been within 5 cm of the goal for five steps, so a mean
return is the share of episodes that succeed. It lasts 50 steps at most, as Gymnasium-Robotics', or
100 where there are disturbances: the gripper slips, the block is nudged, the goal moves.

Observations: the gripper's place (0 to 2), the block's (3 to 5), the block as seen from the gripper
(6 to 8), the fingers (9, 10), angles and velocities (11 to 24), the goal (25 to 27); in metres.

With the shipped weights the selector never calls ``recover``: they are of calm, where nothing goes
wrong. It is there for disturbances (``declare(Disturbances())``).

    skillweave train pick-and-place

Needs gymnasium-robotics: ``pip install 'skillweave[robotics]'``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import skillweave as sw
from skillweave import PPO, Apart, Guide, Hierarchy, Network, Skill, Step
from skillweave.recipes._arm import CALM, Disturbances, is_held as is_grasped, spec
from skillweave.types import Array

GRIPPER = slice(0, 3)
BLOCK = slice(3, 6)
OFFSET = slice(6, 9)
FINGERS = slice(9, 11)
GOAL = slice(25, 28)


def towards(way: Array, fingers: float) -> Array:
    """Return the action (n, 4) that moves the gripper by ``way`` (n, 3) metres; 1 opens fingers."""
    speed = np.clip(10.0 * way, -1.0, 1.0)
    return np.column_stack([speed, np.full(len(way), fingers)]).astype(np.float32)


def above(obs: Array) -> Array:
    """Go to a place above the block, with open fingers."""
    return towards(obs[:, OFFSET] + (0.0, 0.0, 0.1), 1.0)


def descend(obs: Array) -> Array:
    """Go down around the block, with open fingers."""
    return towards(obs[:, OFFSET], 1.0)


def close(obs: Array) -> Array:
    """Close the fingers."""
    return towards(np.zeros((len(obs), 3)), -1.0)


def carry(obs: Array) -> Array:
    """Go to the goal, with closed fingers."""
    return towards(obs[:, GOAL] - obs[:, BLOCK], -1.0)


def is_above(obs: Array) -> Array:
    """Return whether the gripper is straight above the block, or around it, (N,) bool."""
    aligned: Array = np.abs(obs[:, OFFSET][:, :2]).max(axis=1) < 0.015
    return aligned


def is_around(obs: Array) -> Array:
    """Return whether the block is between the fingers, (N,) bool."""
    around: Array = is_above(obs) & (np.abs(obs[:, OFFSET][:, 2]) < 0.012)
    return around


def rule(obs: Array) -> Array:
    """Return the skills (N,) by name, by an engineer's rule."""
    free = np.where(is_around(obs), "close", np.where(is_above(obs), "descend", "above"))
    return np.where(is_grasped(obs), "carry", free)


class Above(Skill):
    """Go above the block, until it is there."""

    policy = above

    def initiation(self, obs: Array) -> Array:
        """Return whether the block is not grasped."""
        return ~is_grasped(obs)

    def termination(self, step: Step) -> Array:
        """Return whether it is above the block."""
        return is_above(step.next_obs)

    success = termination


class Descend(Skill):
    """Go down around the block, until it is there or no longer above it."""

    policy = descend

    def initiation(self, obs: Array) -> Array:
        """Return whether it is above the block, which is not grasped."""
        return is_above(obs) & ~is_grasped(obs)

    def termination(self, step: Step) -> Array:
        """Return whether the block is between the fingers, or elsewhere."""
        return is_around(step.next_obs) | ~is_above(step.next_obs)

    def success(self, step: Step) -> Array:
        """Return whether the block is between the fingers."""
        return is_around(step.next_obs)


class Close(Skill):
    """Close the fingers, until they hold the block."""

    policy = close

    def initiation(self, obs: Array) -> Array:
        """Return whether the fingers are around the block."""
        return is_around(obs) | is_grasped(obs)

    def termination(self, step: Step) -> Array:
        """Return whether they hold it."""
        return is_grasped(step.next_obs)

    success = termination


class Carry(Skill):
    """Bring the grasped block to the goal, until it is lost."""

    policy = carry

    def initiation(self, obs: Array) -> Array:
        """Return whether the block is grasped."""
        return is_grasped(obs)

    def termination(self, step: Step) -> Array:
        """Return whether the block is lost."""
        return ~is_grasped(step.next_obs)


class Anywhere(Skill):
    """One of the four functions, for selectors by hand: it may start anywhere."""

    def __init__(self, name: str, policy: Any) -> None:
        self.name = name
        self.policy = policy


class Recover(Skill):
    """Get the block between the open fingers, wherever it is now. It is learnt."""

    max_steps = 25

    def initiation(self, obs: Array) -> Array:
        """Return whether it is not grasped."""
        return ~is_grasped(obs)

    def reward(self, step: Step) -> Array:
        """Return the fingers' progress to the block in decimetres; 1 for the block between them."""
        before = np.linalg.norm(step.obs[:, OFFSET], axis=1)
        after = np.linalg.norm(step.next_obs[:, OFFSET], axis=1)
        reward: Array = 10.0 * (before - after) + self.success(step)
        return reward

    def termination(self, step: Step) -> Array:
        """Return whether it is between them."""
        return is_around(step.next_obs)

    success = termination


script = sw.Automaton(
    states={"above": "above", "descend": "descend", "close": "close", "carry": "carry"},
    transitions={
        ("above", "descend"): lambda step: is_above(step.next_obs),
        ("descend", "close"): lambda step: is_around(step.next_obs),
        ("close", "carry"): lambda step: is_grasped(step.next_obs),
    },
)
"""The four steps in their order, each until it is done: all one needs where nothing goes wrong."""

behaviour_tree = sw.tree.Sequence(
    sw.tree.Fallback(
        is_grasped,
        sw.tree.Sequence(
            sw.tree.Fallback(is_above, "above"), sw.tree.Fallback(is_around, "descend"), "close"
        ),
    ),
    "carry",
)
"""``rule`` as a tree: it restarts after each call without success."""

RELU = Network(hidden=(64, 64), activation="relu")
LEARNER = PPO(
    learning_rate=1e-3,
    min_advantage_std=0.0,  # the figures were measured with it
    num_envs=16,
    n_steps=128,
    batch_size=256,
    update_epochs=8,
    gamma=0.98,
    gae_lambda=0.95,
    network=RELU,
)
SELECTOR = replace(LEARNER, batch_size=64)
FUNCTIONS = {"above": above, "descend": descend, "close": close, "carry": carry}


def declare(disturbances: Disturbances = CALM, **how: Any) -> Hierarchy:
    """Return the hierarchy whose selector is learnt; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "call_steps": 10,
        "algorithm": LEARNER,
        "selector": SELECTOR,
        "learn": "apart",
        "apart": Apart(skill_steps=20_000, selector_steps=60_000),
    } | how
    skills = [Above(), Descend(), Close(), Carry(), Recover()]
    return Hierarchy(spec(disturbances), skills, **settings)


def anchored(disturbances: Disturbances = CALM, **how: Any) -> Hierarchy:
    """Return the hierarchy whose selector is kept near the behaviour tree while it learns."""
    near = Guide(behaviour_tree, restrict=False, target_kl=0.1)
    return declare(disturbances, **{"guide": near} | how)


def by_hand(selector: Any, disturbances: Disturbances = CALM, call_steps: int = 1) -> Hierarchy:
    """Return the four functions under ``rule``, ``script`` or ``behaviour_tree``, untrained."""
    skills = [Anywhere(name, function) for name, function in FUNCTIONS.items()]
    return Hierarchy(spec(disturbances), skills, selector=selector, call_steps=call_steps)


hierarchy = declare()
