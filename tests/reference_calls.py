"""What a call means, one environment at a time in plain Python: slow, and easy to believe.

Nothing here uses ``skillweave.hierarchy`` or ``skillweave.envs``: the tests compare with it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.skills import Reflex, Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.types import Array, Memory, Step

TAG, EPISODE, T, POSITION = range(4)


class Walk(gym.Env):
    """A walk on the integers; everything about it follows from its seed and the actions.

    Episodes last 3 to 14 steps, drawn at each reset like the tag that tells them apart; they end
    by termination, by truncation, or by both at once. Every step is counted and logged.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def __init__(self) -> None:
        self.episode, self.steps = -1, 0
        self.log: list[tuple[int, int, int]] = []  # (episode, step, action)

    def _obs(self) -> Array:
        return np.array([self.tag, self.episode, self.t, self.position], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.episode += 1
        self.t, self.position = 0, 0
        self.tag = int(self.np_random.integers(1 << 20))
        self.length = int(self.np_random.integers(3, 15))
        self.end = int(self.np_random.integers(3))
        return self._obs(), {}

    def step(self, action: int) -> Any:
        assert self.t < self.length, "stepped after the end"
        self.log.append((self.episode, self.t, int(action)))
        self.steps += 1
        self.t += 1
        self.position += int(action) - 1
        reward = math.sin(1.7 * self.t + self.position + self.tag)
        ended = self.t == self.length
        info = {"t": self.t}
        return self._obs(), reward, ended and self.end != 1, ended and self.end != 0, info


def scripted(action: Any) -> ScriptedPolicy:
    """A policy on ``Walk``: always the same action, or a function of the observations."""
    function = action if callable(action) else lambda obs: np.full(len(obs), action)
    return ScriptedPolicy(function, Walk.observation_space, Walk.action_space)


class Counting(ScriptedPolicy):
    """Remembers how often it acted and what it was paid; the next action follows from both."""

    def __init__(self, choices: int = 3, **spaces: Any) -> None:
        super().__init__(
            lambda obs: np.zeros(len(obs), np.int64),
            spaces.get("observation_space", Walk.observation_space),
            spaces.get("action_space", Walk.action_space),
        )
        self.choices = choices

    def start(self, n: int) -> Memory:
        return {"acted": np.zeros(n, np.int64), "paid": np.zeros(n)}

    def act(self, memory: Memory, obs: Array, mask: Any = None, **how: Any) -> Any:
        action = (memory["acted"] + (memory["paid"] > 0.5)) % self.choices
        return action, {**memory, "acted": memory["acted"] + 1}

    def observe(self, memory: Memory, step: Step) -> Memory:
        return {**memory, "paid": memory["paid"] + step.reward}


class Left(Skill):
    """Three steps to the left."""

    max_steps = 3
    policy = scripted(0)


class Right(Skill):
    """To the right until 2 is passed; may start left of it."""

    policy = scripted(2)

    def initiation(self, obs: Array) -> Array:
        return obs[:, POSITION] < 2

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, POSITION] >= 2


class Zigzag(Skill):
    """Goes by the time in the observation; never stops by itself."""

    policy = scripted(lambda obs: (obs[:, T].astype(np.int64) + obs[:, TAG].astype(np.int64)) % 3)


class Counter(Skill):
    """Acts by its memory; stops when it was unlucky in its call's second step or later."""

    max_steps = 6
    policy = Counting()

    def termination(self, step: Step) -> Array:
        return (step.elapsed >= 2) & (step.reward < -0.5)


def shy() -> Reflex:
    """Where the position is −3: to the right."""
    return Reflex(lambda obs: obs[:, POSITION] == -3, action=2, name="shy")


@dataclass
class Outcome:
    """What a call came to."""

    obs: Array  # to act on next
    next_obs: Array  # the true successor
    reward: float  # Σ γᵏ rₖ
    plain: float  # Σ rₖ
    discount: float  # γ^τ, or 0
    steps: int
    terminated: bool
    truncated: bool


@dataclass
class Scalar:
    """One environment under calls."""

    env: Any
    skills: tuple[Skill, ...]
    call_steps: int | None
    gamma: float
    reflexes: tuple[Reflex, ...] = ()
    policies: tuple[Any, ...] = ()
    obs: Array = field(default_factory=lambda: np.empty(0))
    last: int | None = None  # the skill of this episode's latest call
    memory: Memory = field(default_factory=dict)  # its policy's

    def __post_init__(self) -> None:
        self.policies = self.policies or tuple(s.policy for s in self.skills)

    def reset(self, seeds: Iterator[int]) -> Array:
        self.seeds = seeds
        self.obs, _ = self.env.reset(seed=next(seeds))
        self.last = None
        return self.obs

    def allowed(self) -> list[bool]:
        return [bool(s.initiation(self.obs[None])[0]) for s in self.skills]

    def call(self, choice: int) -> Outcome:
        skill, policy = self.skills[choice], self.policies[choice]
        memory = self.memory if choice == self.last else policy.start(1)
        rewards: list[float] = []
        while True:
            obs, tau = self.obs, len(rewards) + 1
            action, memory = policy.act(memory, obs[None], deterministic=True)
            act = int(action[0])
            for reflex in self.reflexes:
                if reflex.condition(obs[None])[0]:
                    override = reflex.action
                    act = int(override(obs[None])[0] if callable(override) else override)
            self.obs, reward, terminated, truncated, info = self.env.step(act)
            rewards.append(float(np.float32(reward)))  # engines give float32
            step = one_step(obs, act, self.obs, reward, terminated, truncated, tau, skill, info)
            memory = policy.observe(memory, step)
            over = bool(skill.termination(step)[0]) or terminated or truncated
            over |= skill.max_steps is not None and tau >= skill.max_steps
            over |= self.call_steps is not None and tau >= self.call_steps
            if over:
                break
        final = self.obs
        self.last, self.memory = choice, memory
        if terminated or truncated:
            self.obs, _ = self.env.reset(seed=next(self.seeds))
            self.last = None
        return Outcome(
            obs=self.obs,
            next_obs=final,
            reward=sum(self.gamma**k * r for k, r in enumerate(rewards)),
            plain=sum(rewards),
            discount=0.0 if terminated else self.gamma**tau,
            steps=tau,
            terminated=terminated,
            truncated=truncated,
        )


def one_step(
    obs: Array, action: int, next_obs: Array, reward: float, terminated: bool, truncated: bool,
    elapsed: int, skill: Skill, info: Any,
) -> Step:  # fmt: skip
    """A ``Step`` of one environment, with the time as the skill counts it."""
    timed_out = skill.max_steps is not None and elapsed >= skill.max_steps and not terminated
    return Step(
        obs[None], np.array([action]), next_obs[None], np.array([reward], np.float32),
        np.array([terminated]), np.array([truncated]), np.array([timed_out]),
        np.array([elapsed]), info,
    )  # fmt: skip


def seeds_of(seed: int, n: int) -> list[Iterator[int]]:
    """For each environment the seeds that Gymnasium's engine gives its episodes."""

    def of(row: int) -> Iterator[int]:
        for episode in itertools.count():
            node = np.random.SeedSequence(seed, spawn_key=(row, episode))
            yield int(node.generate_state(1, np.uint32)[0]) >> 1

    return [of(row) for row in range(n)]
