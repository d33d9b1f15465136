"""Skills and learners for collectors of skills that learn together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from reference_calls import POSITION, Walk
from toy_acting import Choices, requests

from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.types import Step

N = 4


class Up(Skill):
    """Ends by itself on even positions, after three steps at most."""

    max_steps = 3

    def reward(self, step: Step):
        return step.next_obs[:, POSITION] - step.obs[:, POSITION] + 0.25 * step.elapsed

    def termination(self, step: Step):
        return step.next_obs[:, POSITION] % 4 == 0


class Down(Skill):
    """Never ends by itself."""

    def reward(self, step: Step):
        return step.obs[:, POSITION] - step.next_obs[:, POSITION]


class Stay(Skill):
    """Is ready: it does not learn."""

    policy = ScriptedPolicy(lambda obs: np.ones(len(obs), int))


class Learner(Choices):
    """Acts as a learner would: one member, no memory."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, 3)
        env = Walk()

        class Algorithm:
            observation_space, action_space = env.observation_space, env.action_space

        self.stacks = ((Algorithm(), 1),)


class Values(Learner):
    """A critic to whom skill k is worth k where the position is odd, else nothing.

    A new decision is worth as much as the best skill.
    """

    def some(self, rows, obs, mask, memory):
        found = super().some(rows, obs, mask, memory)
        odd = obs[:, POSITION] % 2 == 1
        return replace(found, dist_params=odd[:, None] * np.array([0, 1, 2, 2], np.float32))


def asked(rows, paths=("up", "down", "skill_critic")):
    """Requests of ``rows`` rows for the selector and those that learn below it."""
    for request in requests(rows):
        yield replace(request, below=dict.fromkeys(paths, request))
