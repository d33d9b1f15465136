"""Key and door (MiniGrid): three skills and a selector that learn together, from nothing.

    pip install minigrid
    python examples/doorkey.py

The third skill would never see a state that it is for, if it learnt apart: behind the door. Here
all learn from the same steps, and the others lead it there. ``--room`` names another room with a
key and a door, such as DoorKey-16x16, or UnlockPickup, where a box is to be picked up behind the
door. They take more steps.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np

import skillweave as sw
from skillweave.envs import PoolWrapper
from skillweave.types import Array

KEY, DOOR, OPEN = 5, 4, 0
ROOM = "DoorKey-8x8"


def make(render_mode: str | None = None, room: str = ROOM) -> gym.Env[Any, Any]:
    """Return a room; observations are the 7×7 cells in view: kind, colour and state of each."""
    import minigrid  # noqa: F401, it registers the environments
    from minigrid.wrappers import ImgObsWrapper

    return ImgObsWrapper(gym.make(f"MiniGrid-{room}-v0", render_mode=render_mode))


class Image(PoolWrapper):
    """Observations of EnvPool's rooms as those of ``make``: the image alone."""

    def __init__(self, pool: Any) -> None:
        super().__init__(pool, pool.observation_space["image"])

    def see(self, obs: Any, ids: Array) -> Array:
        image: Array = obs["image"]
        return image


def many(num_envs: int, threads: int, seed: int, room: str = ROOM) -> Image:
    """Make the room in EnvPool, ten times as fast."""
    return Image(sw.envs.envpool(f"MiniGrid-{room}-v0", num_envs, threads, seed))


def carrying(obs: Array) -> Array:
    """(N,) bool, the key is in the agent's hands."""
    return obs[:, 3, 6, 0] == KEY


def door_open(obs: Array) -> Array:
    """(N,) bool, an open door is in view."""
    return ((obs[..., 0] == DOOR) & (obs[..., 2] == OPEN)).any((1, 2))


class GetKey(sw.Skill):
    """Picks up the key."""

    max_steps = 64

    def reward(self, step: sw.Step) -> Array:
        return (carrying(step.next_obs) & ~carrying(step.obs)) - 0.01

    def termination(self, step: sw.Step) -> Array:
        return carrying(step.next_obs)


class OpenDoor(sw.Skill):
    """Opens the door, once the key is there."""

    max_steps = 64

    def initiation(self, obs: Array) -> Array:
        return carrying(obs)

    def reward(self, step: sw.Step) -> Array:
        return (door_open(step.next_obs) & ~door_open(step.obs)) - 0.01

    def termination(self, step: sw.Step) -> Array:
        return door_open(step.next_obs)


class Goal(sw.Skill):
    """Does what the task pays for: reaches the goal, or picks up the box."""

    max_steps = 64

    def reward(self, step: sw.Step) -> Array:
        return step.reward * 10 - 0.01


def algorithm(kind: type[sw.PPO] = sw.PPO, **how: Any) -> sw.PPO:
    """Return the learner's settings; ``encoder="cells"``: a cell's numbers are kinds of things."""
    settings: dict[str, Any] = {
        "num_envs": 16,
        "n_steps": 128,
        "batch_size": 256,
        "update_epochs": 4,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "learning_rate": 1e-3,
        "learning_rate_schedule": "constant",
        "network": sw.Network(hidden=(64,), encoder="cells"),
    }
    return kind(**settings | how)


def declare(
    room: str = ROOM,
    steps: int = 500_000,
    workers: int | None = None,
    engine: Literal["auto", "sync"] = "auto",
    **how: Any,
) -> sw.Hierarchy:
    """Return the hierarchy; ``how`` changes any of its settings.

    Args:
        room: MiniGrid's name of it, without version.
        engine: auto: in EnvPool, where it is installed; sync: in Python.
    """
    # Here minibatches twice as large, with a rate √2 times as high, are as good and take less time.
    # Other rooms are taken to be harder: where successes are rare at first, PPO forgets one before
    # the next comes.
    here = room == ROOM
    fast: dict[str, Any] = {"batch_size": 512, "learning_rate": 1.4e-3}
    learner = algorithm(**fast) if here else algorithm(sw.algorithms.SelfImitationPPO)
    settings: dict[str, Any] = {
        "call_steps": 32,
        "steps": steps,
        # At first any skill that may start is called: else one that may start anywhere takes all.
        "together": sw.Together(task_weight=0.0, epsilon=1.0, epsilon_final=0.1),
        # A call that ends at once is not worth as much as one that does not. But before anything is
        # won, a cost teaches the selector to call the skill with the longest calls, and in other
        # rooms that lasts long. There is none there, at the risk of calls that end at once again
        # and again.
        "selection": sw.Selection(deliberation_cost=0.001 if here else 0.0, greedy_skills=False),
        "algorithm": learner,
        "selector": learner,
    } | how
    other: dict[str, Any] = {} if here else {"room": room}
    env = sw.EnvSpec(make, other, pool=partial(many, **other), engine=engine, workers=workers)
    return sw.Hierarchy(env, [GetKey(), OpenDoor(), Goal()], **settings)


hierarchy = declare()


def main() -> None:
    """Train it, and say how many episodes it solves."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--room", default=ROOM)
    parser.add_argument("--steps", type=int, default=500_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="how many episodes score it")
    parser.add_argument("--out", default="runs/doorkey")
    asked = parser.parse_args()
    run = declare(asked.room, asked.steps).train(asked.out, seed=asked.seed)
    found = run.evaluate(asked.episodes)
    print(found.for_people())
    print(f"solved: {np.mean(np.array(found.returns) > 0):.0%} of the episodes")


if __name__ == "__main__":
    main()
