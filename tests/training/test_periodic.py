"""Evaluating an agent while it trains."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
from toys import Calls, Clockwork, Countdown, Echo, Toy

from skillweave import (
    PPO,
    Network,
)
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.envs import checked
from skillweave.experience.collector import RETURN
from skillweave.experience.learners import Alone
from skillweave.training.periodic import PeriodicEvaluation, episodes_of

SMALL = Network((8,), "relu")


def fresh(env: Toy) -> AgentPolicy:
    """A policy that has learnt nothing."""
    algorithm = make_algorithm(PPO(network=SMALL), env.observation_space, env.action_space)
    return AgentPolicy.of(algorithm, algorithm.init([Seeds(0)]))


def played(env: Toy, seed: int = 0) -> list[float]:
    who = env.collector(None).who
    return episodes_of(fresh(env), who, env, Seeds(seed))[:, RETURN].tolist()


def played_by_hand(env, policy: AgentPolicy) -> list[float]:
    """The return of each environment's first episode, one environment at a time."""
    found = []
    for i in range(env.num_envs):
        obs, over, total = env.reset(0), False, 0.0
        while not over:
            step = env.step(policy.act({}, obs)[0])
            total += float(step.reward[i])
            over, obs = bool(step.terminated[i] or step.truncated[i]), step.next_obs
            ended = np.flatnonzero(step.terminated | step.truncated)
            if len(ended):
                env.reset_some(ended)
                obs = env.obs
        found.append(total)
    return found


def test_only_first_episodes_count_though_they_differ_in_length():
    got = played(Clockwork(range(6)))
    assert got == played_by_hand(Clockwork(range(6)), fresh(Clockwork(range(6))))
    assert len(set(got)) > 1


def test_an_episode_that_never_ends_counts_as_it_stands_at_the_limit(monkeypatch):
    class Forever(Countdown):
        """Pays 1 a step; only the first environment ends, after 5 steps."""

        def play(self, action):
            obs, reward, terminated, truncated = super().play(action)
            return np.minimum(obs, 5), reward, terminated & (np.arange(2) == 0), truncated

    monkeypatch.setattr(checked, "LONG_EPISODE", 8)
    assert played(Forever(2)) == [5.0, 8.0]


def test_the_limit_counts_environment_steps_not_decisions(monkeypatch):
    monkeypatch.setattr(checked, "LONG_EPISODE", 25)
    assert played(Calls(1, (False, True))) == [9.0]  # calls of 10 steps, of which each pays 3


def test_equal_seeds_give_equal_starts_and_others_other_ones():
    env = Echo(50, "vector", "Box")
    first, again, other = (played(env, seed) for seed in (1, 1, 2))
    assert first == again != other


def test_an_evaluation_is_made_once_in_every_so_many_steps():
    learning_task = SimpleNamespace(engine=Countdown)
    policy = fresh(Countdown(1))

    def play(engine, seeds: Seeds):
        return episodes_of(policy, Alone(), engine, seeds)

    evaluation = PeriodicEvaluation(learning_task, Seeds(0), 100, 3, 8)
    ticks = (250, 260, 299, 300, 350, 520, 599, 601)
    pairs = itertools.pairwise(ticks)
    assert [t for since, t in pairs if evaluation.due(since, t, play)] == [300, 520, 601]
    assert evaluation.spent() == 3 * 3 * 5
    assert evaluation.due(601, 700, play) == {"eval_return": 5.0, "eval_return_min": 5.0}
    assert (evaluation.spent(), evaluation.spent()) == (15, 0)
    never = PeriodicEvaluation(learning_task, Seeds(0), None, 3, 8)
    assert never.due(0, 10**6, play) == {}
