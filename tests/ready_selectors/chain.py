"""A corridor in which one thing must be done after another, and skills for it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.envs.make import EnvSpec
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.skills import Skill, ready_selector
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Array, Memory, Step

PLACE, KEY, DOOR = range(3)
LAST = 6


class Corridor(gym.Env):
    """Places 0 to 6: the key lies at 0; with it the door at 6 opens; behind that, at 7, is the end.

    An episode begins at a place from 1 to 5, drawn by its seed, and is cut after 40 steps. The last
    step pays 1. Actions: to the left, stay, to the right.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.key, self.door, self.t = int(self.np_random.integers(1, 6)), 0, 0, 0
        return self._obs(), {}

    def step(self, action: int) -> Any:
        self.t += 1
        self.place = max(0, min(self.place + int(action) - 1, LAST + self.door))
        self.key |= self.place == 0
        self.door |= self.place == LAST and self.key
        over = self.place > LAST
        return self._obs(), float(over), over, self.t == 40, {"door": self.door}

    def _obs(self) -> Array:
        return np.array([self.place, self.key, self.door], np.float32)


SPEC = EnvSpec(Corridor, engine="sync")


def always(action: int) -> ScriptedPolicy:
    return ScriptedPolicy(
        lambda obs: np.full(len(obs), action), Corridor.observation_space, Corridor.action_space
    )


class GetKey(Skill):
    """To the left until the key is there."""

    policy = always(0)

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, KEY] == 1


class OpenDoor(Skill):
    """To the right, at most 12 steps; it may start with the key only."""

    max_steps = 12
    policy = always(2)

    def initiation(self, obs: Array) -> Array:
        return obs[:, KEY] == 1

    def success(self, step: Step) -> Array:
        return step.next_obs[:, DOOR] == 1

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, PLACE] == LAST


class Leave(Skill):
    """One step to the right."""

    max_steps = 1
    policy = always(2)


class Wait(Skill):
    """Two steps of nothing."""

    max_steps = 2
    policy = always(1)


class InDict(gym.ObservationWrapper):  # type: ignore[type-arg]
    """Shows the place and the door, each by a name."""

    observation_space = gym.spaces.Dict(
        {"door": gym.spaces.Discrete(2), "at": gym.spaces.Box(0, 9, (1,))}
    )

    def observation(self, obs: Any) -> Any:
        return {"at": obs[:1], "door": int(obs[DOOR])}


NAMES = ("get_key", "open_door", "leave", "wait")


def has_key(obs: Array) -> Array:
    return obs[:, KEY] == 1


def got_key(step: Step) -> Array:
    return step.next_obs[:, KEY] == 1


def at_four(obs: Array) -> Array:
    return obs[:, PLACE] == 4


def bound(selector: Any, names: tuple[str, ...] = NAMES) -> Any:
    """A selector on the corridor's observations."""
    found = ready_selector(selector, names)
    assert found is not None
    return found.bind(Corridor.observation_space, gym.spaces.Discrete(len(names)), "selector")


def hierarchy(selector: Any, call_steps: int | None = None, skills: Any = ()) -> HierarchyPolicy:
    skills = skills or (GetKey(), OpenDoor(), Leave(), Wait())
    policies = tuple(s.policy for s in skills)
    names = tuple(s.name for s in skills)
    return HierarchyPolicy(bound(selector, names), SkillSet(skills, policies, (), call_steps))


def played(policy: HierarchyPolicy, seed: int, **how: Any) -> Iterator[tuple[Memory, Memory]]:
    """What a policy remembers before and after it acts in each step of an episode."""
    env = Corridor()
    obs, _ = env.reset(seed=seed)
    memory, over, t = policy.start(1), False, 0
    while not over:
        before, here = memory, obs[None]
        action, memory = policy.act(memory, here, **how)
        yield before, memory
        obs, reward, terminated, truncated, info = env.step(int(action[0]))
        over, t = terminated or truncated, t + 1
        step = Step(
            here, action, obs[None], np.float32([reward]), np.array([terminated]),
            np.array([truncated]), np.zeros(1, bool), np.array([t]),
            {"door": np.array([info["door"]])},
        )  # fmt: skip
        memory = policy.observe(memory, step)


def story(policy: HierarchyPolicy, seed: int) -> list[tuple[str, int]]:
    """The calls of an episode: each skill's name and how many steps it lasted."""
    calls: list[Any] = []
    for _, memory in played(policy, seed):
        if memory["elapsed"][0] == 0:
            calls.append([policy.labels[int(memory["skill"][0])], 0])
        calls[-1][1] += 1
    return [tuple(c) for c in calls]
