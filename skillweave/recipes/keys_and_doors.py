"""Keys and doors: eight skills for MiniGrid's rooms, and a selector.

The agent sees the 7×7 cells before it: kind, colour and state of each. Seven skills are learnt
once, in small rooms of several kinds, each for what it can see: a key, a shut door, a ball; one is
written by hand. Each further task pays a reward only at its end. There, skills and selector
continue to learn together (``going_on``), or a selector learns alone (``with_skills``).

    skillweave train keys-and-doors

Needs MiniGrid: ``pip install 'skillweave[minigrid]'``; with EnvPool it trains ten times as fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave import PPO, Apart, Hierarchy, Network, Selection, Skill, Step, Together
from skillweave.recipes._rooms import (
    BALL,
    BOX,
    CLOSED,
    DOOR,
    DROP,
    FORWARD,
    GOAL,
    KEY,
    LOCKED,
    OPEN,
    TOGGLE,
    LookAround,
    ahead,
    anywhere,
    at_open_door,
    between_walls,
    free,
    holds,
    in_view,
    seen,
    shut,
    spec,
    steps_to,
)
from skillweave.recipes._specs import given
from skillweave.types import Array


class Errand(Skill):
    """Do one thing as fast as possible; subclasses define it in ``success``."""

    max_steps = 32

    def reward(self, step: Step) -> Array:
        """Return 1 where it is done; before, 0.04 for each cell nearer; less 0.02 a step.

        "Nearer" is the distance to its target; a skill without a target is paid only at its end.
        """
        before, after = steps_to(self.aim(step.obs)), steps_to(self.aim(step.next_obs))
        reward: Array = np.where(self.success(step), 1.0, 0.04 * (before - after)) - 0.02
        return reward

    def aim(self, obs: Array) -> Array:
        """Return the cells of its target, (n, 7, 7) bool; the default is none."""
        return np.zeros(obs.shape[:3], bool)

    def initiation(self, obs: Array) -> Array:
        """Return whether its target is in view."""
        return anywhere(self.aim(obs))

    def success(self, step: Step) -> Array:
        """Return whether it is done, (N,) bool."""
        raise NotImplementedError

    def termination(self, step: Step) -> Array:
        """Return whether it is done."""
        return self.success(step)


class Explore(Errand):
    """Go about until there is something to do: written by hand, nothing is learnt."""

    max_steps = 16
    policy = LookAround()

    def initiation(self, obs: Array) -> Array:
        """Return whether there is nothing to do; but `drop` or `next_room` may start."""
        return ~something_to_do(obs)

    def success(self, step: Step) -> Array:
        """Return whether there is something to do."""
        return something_to_do(step.next_obs)


def something_to_do(obs: Array) -> Array:
    """Return whether a skill with a target in view may start, (n,) bool.

    `next_room` does not count: an agent without memory would walk to and fro through one door.
    """
    may_start: Array = np.any([skill.initiation(obs) for skill in ERRANDS], axis=0)
    return may_start


class GetKey(Errand):
    """Pick up a key."""

    def aim(self, obs: Array) -> Array:
        """Return keys, while its hands are free."""
        return seen(obs, KEY) & ~holds(obs)[:, None, None]

    def success(self, step: Step) -> Array:
        """Return whether it has the key."""
        return holds(step.next_obs, KEY)


class PickUp(Errand):
    """Pick up a ball or a box."""

    def aim(self, obs: Array) -> Array:
        """Return balls and boxes, while its hands are free."""
        return seen(obs, BALL, BOX) & ~holds(obs)[:, None, None]

    def success(self, step: Step) -> Array:
        """Return whether it holds one."""
        return holds(step.next_obs, BALL, BOX)


class OpenBox(Errand):
    """Open a box: what is in it lies in its place then."""

    def aim(self, obs: Array) -> Array:
        """Return boxes, while its hands are free."""
        return seen(obs, BOX) & ~holds(obs)[:, None, None]

    def success(self, step: Step) -> Array:
        """Return whether the box before it is gone."""
        before, after = ahead(step.obs)[:, 0], ahead(step.next_obs)[:, 0]
        opened: Array = (step.action == TOGGLE) & (before == BOX) & (after != BOX)
        return opened


class Drop(Errand):
    """Put down what it holds."""

    max_steps = 8

    def initiation(self, obs: Array) -> Array:
        """Return whether it holds something."""
        return holds(obs)

    def success(self, step: Step) -> Array:
        """Return whether its hands are free."""
        dropped: Array = (step.action == DROP) & ~holds(step.next_obs)
        return dropped


class OpenDoor(Errand):
    """Open a door that is shut."""

    def aim(self, obs: Array) -> Array:
        """Return closed doors, and locked ones while it holds a key."""
        locked = seen(obs, DOOR, state=LOCKED) & holds(obs, KEY)[:, None, None]
        return seen(obs, DOOR, state=CLOSED) | locked

    def reward(self, step: Step) -> Array:
        """Take 1 off where it shuts a door: else it would do so to open it again."""
        shuts = at_open_door(step.obs) & shut(ahead(step.next_obs)) & (step.action == TOGGLE)
        reward: Array = np.where(shuts, -1.02, super().reward(step))
        return reward

    def success(self, step: Step) -> Array:
        """Return whether the door before it is open now."""
        now_open = shut(ahead(step.obs)) & at_open_door(step.next_obs)
        opened: Array = now_open & (step.action == TOGGLE)
        return opened


class NextRoom(Errand):
    """Go through an open door."""

    def initiation(self, obs: Array) -> Array:
        """Return whether an open door is in view."""
        return in_view(obs, DOOR, state=OPEN)

    def success(self, step: Step) -> Array:
        """Return whether it leaves a doorway straight on."""
        on = (step.action == FORWARD) & free(ahead(step.obs))
        entered: Array = on & between_walls(step.obs) & ~between_walls(step.next_obs)
        return entered


class ReachGoal(Errand):
    """Go to the goal."""

    def aim(self, obs: Array) -> Array:
        """Return the goal."""
        return seen(obs, GOAL)

    def success(self, step: Step) -> Array:
        """Return whether it enters the goal."""
        reached: Array = (step.action == FORWARD) & (ahead(step.obs)[:, 0] == GOAL)
        return reached


CELLS = Network(hidden=(64,), encoder="cells")  # a cell's numbers are kinds, not brightnesses
WORKER = PPO(
    min_advantage_std=0.0,  # the figures were measured with it
    num_envs=128,
    n_steps=32,
    batch_size=256,
    update_epochs=8,  # most rows are of other skills, on the way to a start
    learning_rate=1e-3,
    gamma=0.98,
    gae_lambda=0.95,
    ent_coef=0.01,
    network=CELLS,
)
SELECTOR = PPO(
    learning_rate=1e-3,
    min_advantage_std=0.0,  # the figures were measured with it
    num_envs=32,
    n_steps=256,
    batch_size=64,  # a rollout has few decisions
    update_epochs=8,
    gamma=0.995,
    gae_lambda=0.95,
    ent_coef=0.02,
    ent_coef_final=0.005,
    network=CELLS,
)
SKILLS = (Explore, OpenDoor, NextRoom, GetKey, ReachGoal, PickUp, Drop, OpenBox)
ERRANDS = (GetKey(), OpenDoor(), ReachGoal(), PickUp(), OpenBox())

STEPS = {
    "open_door": 800_000,
    "next_room": 800_000,
    "get_key": 600_000,
    "reach_goal": 1_200_000,
    "pick_up": 1_000_000,
    "drop": 100_000,
    "open_box": 800_000,
}
"""Training steps of each skill; most of them are spent on the way to where it may start."""


APART = Apart(
    skill_steps=100_000,
    selector_steps=200_000,
    start_calls=4,
    search_steps=64,  # not every kind of room has something for every skill
)


def declare(rooms: str = "small", **how: Any) -> Hierarchy:
    """Return the hierarchy in these rooms; ``how`` changes any of its settings."""
    settings: dict[str, Any] = {
        "call_steps": None,
        "learn": "apart",
        "apart": APART,
        "selection": Selection(greedy_skills=False),
        "algorithm": WORKER,
        "selector": SELECTOR,
    } | how
    hierarchy = Hierarchy(spec(rooms), [s() for s in SKILLS], **settings)
    for name, steps in STEPS.items():
        hierarchy.skill(name).steps = steps
    return hierarchy


def with_skills(rooms: str, skills: Mapping[str, Any], **how: Any) -> Hierarchy:
    """Return the hierarchy in these rooms with learnt skills, by name; only the selector learns."""
    how = {"apart": replace(APART, selector_steps=1_500_000)} | how
    return given(declare(rooms, **how), skills)


def going_on(rooms: str, **how: Any) -> Hierarchy:
    """Return the hierarchy in these rooms, where skills and selector continue to learn, together.

    To be trained from the run in the small rooms: ``train(..., start_from=run)``.
    """
    again: dict[str, Any] = {
        "learn": "together",
        "together": Together(steps=750_000, task_weight=1.0, epsilon=0.1, epsilon_final=0.0),
    }
    return declare(rooms, **(again | how))


hierarchy = declare()
