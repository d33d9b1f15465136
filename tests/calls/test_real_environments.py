"""Calls in real environments, below a network, against a scalar loop."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from calls.users import Learner
from reference_calls import Scalar, seeds_of

from skillweave.algorithms.config import PPO
from skillweave.algorithms.policy import AgentPolicy, make_algorithm
from skillweave.collecting.acting import Request
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.decisions import DecisionCollector
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.hierarchy.options import OptionsEnv
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.seeding import Seeds
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.training.play import SeededEpisodes, play
from skillweave.types import Array, Step

N, GAMMA = 3, 0.99


def acts(function: Any) -> ScriptedPolicy:
    return ScriptedPolicy(lambda obs: function(obs).astype(np.int64))


class Push(Skill):
    """CartPole: to the left. LunarLander: nothing."""

    max_steps = 2
    policy = acts(lambda obs: np.zeros(len(obs)))


class Balance(Skill):
    """CartPole: against the fall, while the cart is left of the middle."""

    policy = acts(lambda obs: obs[:, 2] + obs[:, 3] > 0)

    def initiation(self, obs: Array) -> Array:
        return obs[:, 0] < 0.05

    def termination(self, step: Step) -> Array:
        return np.abs(step.next_obs[:, 1]) > 0.4


class Hover(Skill):
    """LunarLander: the main engine while sinking, until rising."""

    policy = acts(lambda obs: np.where(obs[:, 3] < -0.1, 2, 0))

    def initiation(self, obs: Array) -> Array:
        return obs[:, 3] < 0

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, 3] > 0


class Turn(Skill):
    """LunarLander: against the lean."""

    policy = acts(lambda obs: np.where(obs[:, 4] > 0, 3, 1))


class Setting:
    """Skills below a network, in environments with a time limit."""

    def __init__(self, env_id: str, kinds: Any, limit: int) -> None:
        skills = tuple(kind() for kind in kinds)
        self.make = lambda: gym.make(env_id, max_episode_steps=limit)
        self.skills = SkillSet(skills, tuple(s.policy for s in skills), call_steps=7)
        config, env = PPO(num_envs=1, n_steps=1, batch_size=1), self.make()
        choices = gym.spaces.Discrete(len(skills))
        algorithm = make_algorithm(config, env.observation_space, choices)
        state = algorithm.init([Seeds(0)])
        with torch.no_grad():
            state.params[:] = 5 * state.params
        self.network: Any = AgentPolicy.of(algorithm, state)
        self.network.size = 0

    def engine(self) -> Any:
        return make_engine(EnvSpec(self.make, engine="sync"), N)

    def calls(self, seeds: Iterator[int]) -> Iterator[dict[str, Any]]:
        """The calls in one environment, from a scalar loop."""
        scalar = Scalar(self.make(), self.skills.skills, 7, GAMMA)
        obs = scalar.reset(seeds)
        while True:
            choice, _ = self.network.act({}, obs[None], np.array([scalar.allowed()]))
            call = scalar.call(int(choice[0]))
            yield {"obs": obs, "action": int(choice[0])} | {
                k: getattr(call, k)
                for k in ("next_obs", "reward", "steps", "terminated", "truncated")
            }
            obs = call.obs


def collected(setting: Setting) -> list[list[dict[str, Any]]]:
    collector = DecisionCollector(setting.engine(), Learner(setting.network), setting.skills)
    collector.start(Seeds(7))
    rows = collector.collect(Request(300, (), np.array([GAMMA]), Seeds(0))).batches[""]
    columns: list[list[dict[str, Any]]] = [[] for _ in range(N)]
    for t, n in zip(*np.nonzero(rows.valid_rows), strict=True):
        columns[n].append({k: v[t, n] for k, v in rows.items()})
    return columns


def as_options(setting: Setting) -> list[list[dict[str, Any]]]:
    env = OptionsEnv(setting.engine(), setting.skills, GAMMA)
    columns: list[list[dict[str, Any]]] = [[] for _ in range(N)]
    obs, info = env.reset(seed=(Seeds(7) / "env").integer())
    for _ in range(60):
        choice, _ = setting.network.act({}, obs, info.get("action_mask"))
        rows = {"obs": obs, "action": choice}
        obs, reward, terminated, truncated, info = env.step(choice)
        rows |= {"reward": reward, "terminated": terminated, "truncated": truncated}
        rows |= {"next_obs": info["next_obs"], "steps": info["steps"]}
        for n in range(N):
            columns[n].append({k: v[n] for k, v in rows.items()})
    return columns


SETTINGS = {
    "CartPole-v1": ((Push, Balance, Push), 12),
    "LunarLander-v3": ((Push, Hover, Turn), 110),
}


@pytest.mark.parametrize("play_calls", [collected, as_options])
@pytest.mark.parametrize("env_id", SETTINGS)
def test_calls_are_those_of_a_scalar_loop(env_id: str, play_calls: Any) -> None:
    setting = Setting(env_id, *SETTINGS[env_id])
    seen: dict[str, set[Any]] = defaultdict(set)
    seeds = seeds_of((Seeds(7) / "env").integer(), N)
    for column, own in zip(play_calls(setting), seeds, strict=True):
        for row, call in zip(column, setting.calls(own), strict=False):
            for name, value in call.items():
                np.testing.assert_allclose(row[name], value, rtol=1e-5, atol=1e-5, err_msg=name)
                if name in ("terminated", "truncated", "steps", "action"):
                    seen[name].add(int(value))
    assert seen["terminated"] == seen["truncated"] == {0, 1}
    assert len(seen["steps"]) > 3
    assert len(seen["action"]) > 1


@pytest.mark.parametrize("env_id", SETTINGS)
def test_episodes_of_an_evaluation_are_those_of_a_scalar_loop(env_id: str) -> None:
    setting = Setting(env_id, *SETTINGS[env_id])
    seeds = [*range(50, 56)]
    policy = HierarchyPolicy(setting.network, setting.skills)
    began: dict[int, list[Any]] = defaultdict(list)
    for step in play(policy, SeededEpisodes(setting.engine(), seeds, 1_000)):
        for k, e in enumerate(step.episode):
            if step.begun[k]:
                began[e].append([int(step.acting[k]), 0, step.step.obs[k].tolist()])
            began[e][-1][1] += 1
    for e, seed in enumerate(seeds):
        calls = setting.calls(iter([seed, 0]))
        for action, steps, obs in began[e]:
            call = next(calls)
            assert (call["action"], call["steps"], call["obs"].tolist()) == (action, steps, obs)
        assert call["terminated"] or call["truncated"]
