"""Hierarchies with random networks, for exports."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from playing import alike
from random_networks import agent
from reference_calls import POSITION, TAG, Left, Right, T, Walk, Zigzag, scripted, shy
from toys import skills_of

from skillweave import PPO, Automaton, Lengths, Network
from skillweave.algorithms import RNN
from skillweave.algorithms.config import SkillCritic
from skillweave.api.player import Player
from skillweave.export import compile
from skillweave.export.graphs import agent_graph
from skillweave.export.runner import Runner
from skillweave.hierarchy.policy import HierarchyPolicy, with_interruption
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.skills import Skill, ready_selector
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Array, LastCall, Step


@cache
def traced_before(policy: Any, sampled: bool) -> Any:
    return agent_graph(policy, sampled, "a network of these tests")


@pytest.fixture(autouse=True)
def traced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracing takes a second, and these policies share their networks."""
    monkeypatch.setattr(compile, "agent_graph", lambda p, sampled, _: traced_before(p, sampled))


class LongWalk(Walk):
    """Episodes of 30 to 60 steps, whose numbers are of about one size."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.tag, self.length = self.tag % 7, int(self.np_random.integers(30, 60))
        return self._obs(), {}


OBS, ACTIONS = Walk.observation_space, Walk.action_space


@cache
def network(choices: int, rnn: RNN | None = None, seed: int = 0) -> Any:
    config = PPO(network=Network((8,), rnn=rnn), normalize_obs=False)
    return agent(config, OBS, gym.spaces.Discrete(choices), seed=seed)


class Careful(Skill):
    """May start at even positions; stops where its last action led to an odd one."""

    max_steps = 7
    policy = scripted(lambda obs: (obs[:, T].astype(int) // 2 + obs[:, TAG].astype(int)) % 3)

    def initiation(self, obs: Array) -> Array:
        return obs[:, POSITION] % 2 == 0

    def termination(self, step: Step) -> Array:
        return step.timed_out | (step.info["t"] % 5 == 0) | (step.obs[:, T] > step.elapsed + 20)

    def success(self, step: Step) -> Array:
        return step.elapsed > 2


class Remembers(Skill):
    """A recurrent network."""

    call_steps = 2
    policy = network(3, RNN("gru", 4))


class Free(Skill):
    """A network that may start everywhere."""

    policy = network(3, seed=3)


skill_set = functools.partial(skills_of, call_steps=4)


def ready(value: Any, skills: SkillSet) -> HierarchyPolicy:
    selector = ready_selector(value, tuple(s.name for s in skills.skills))
    assert selector is not None
    choices = gym.spaces.Discrete(len(skills.skills))
    return HierarchyPolicy(selector.bind(OBS, choices, "selector"), skills)


def trained(skills: SkillSet, seed: int = 1) -> HierarchyPolicy:
    return HierarchyPolicy(network(skills.choices, seed=seed), skills)


def far(step: Step) -> Array:
    return np.abs(step.next_obs[:, POSITION]) + step.reward * 0 > 2


def nested() -> HierarchyPolicy:
    inner = trained(skill_set(Left, Careful, Zigzag, call_steps=3, reflexes=(shy(),)))

    class Inner(Skill):
        max_steps = 5
        policy = inner

    return trained(skill_set(Inner, Zigzag, call_steps=8), seed=5)


def critic_of(skills: int, **how: Any) -> Any:
    algorithm = SkillCritic(network=Network((8,)), normalize_obs=False, **how)
    return agent(algorithm, OBS, gym.spaces.Discrete(skills), seed=2)


def interrupted(margin: float, **how: Any) -> HierarchyPolicy:
    skills = skill_set(Careful, Left, Free, call_steps=9)
    return trained(with_interruption(skills, critic_of(3, **how), margin))


AUTOMATON = Automaton(
    {"near": ["careful", "left"], "far": "zigzag", "home": ["right", "zigzag"]},
    {("near", "far"): far, ("far", "home"): "failure", ("home", "near"): "success",
     ("home", "far"): "failure"},
)  # fmt: skip


GUIDED = ActiveGuide(
    ready_selector(AUTOMATON, ("careful", "left", "zigzag", "right")),  # type: ignore[arg-type]
)


def choose(obs: Array, last: LastCall) -> Array:
    return np.where(last.succeeded, 1, (obs[:, T].astype(int) + last.skill) % 2)


HIERARCHIES: dict[str, Any] = {
    "automaton": lambda: ready(AUTOMATON, skill_set(Careful, Left, Zigzag, Right)),
    "function": lambda: ready(choose, skill_set(Careful, Zigzag, reflexes=(shy(),))),
    "guide": lambda: HierarchyPolicy(
        network(4, seed=7), skill_set(Careful, Left, Zigzag, Right), GUIDED
    ),
    "lengths": lambda: trained(skill_set(Left, Free, call_steps=Lengths(1, 3))),
    "nested": nested,
    "memories": lambda: trained(skill_set(Remembers, Left, Free), 2),
    "interrupted": lambda: interrupted(0.02, deciding=True),
}


def played(policies: Sequence[Any], *runners: Runner, n: int = 5) -> set[tuple[str, int, bool]]:
    """Play n episodes, in which all act alike; all skills, actions, and whether one decided."""
    players, told = [Player(policy) for policy in policies], set()
    for seed in range(n):
        for action in alike(LongWalk(), *players, *runners, seed=seed):
            (name,) = {p.acts(actor.memory) for p, actor in zip(policies, players, strict=True)}
            (_,) = {int(actor.memory["skill"][0]) for actor in (*players, *runners)}
            told.add((name, int(action), players[0].memory["elapsed"][0] == 0))
    return told
