"""Evaluating an agent while it trains."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from skillweave import DQN, PPO, Hierarchy, Network, Skill, SkillweaveError
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors
from skillweave.seeding import Seeds
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.training.periodic import PeriodicEvaluation, first_episodes
from tests.toys import Calls, Clockwork, Countdown, Identity


def played_by_hand(env: Any, seeds: Seeds) -> list[float]:
    """The return of each environment's first episode under action 0, one environment at a time."""
    obs, n = env.reset(seeds / "start"), env.num_envs
    found, over = [0.0] * n, [False] * n
    while not all(over):
        step = env.step(np.zeros(n, np.int64))
        for i in range(n):
            if not over[i]:
                found[i] += float(step.reward[i])
                over[i] = bool(step.terminated[i] or step.truncated[i])
    assert obs is not None
    return found


def test_only_first_episodes_count_though_they_differ_in_length():
    env = Clockwork(range(6))
    policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64))
    got, _ = first_episodes(policy, env, Seeds(0))
    assert got.tolist() == played_by_hand(Clockwork(range(6)), Seeds(0))
    assert len(set(got.tolist())) > 1


def test_an_episode_that_never_ends_counts_as_it_stands_at_the_limit():
    class Forever(Countdown):
        """Pays 1 a step; only the first environment ends, after 5 steps."""

        def play(self, action: Any) -> Any:
            obs, reward, terminated, truncated, steps = super().play(action)
            return np.minimum(obs, 5), reward, terminated & (np.arange(2) == 0), truncated, steps

    policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64))
    assert first_episodes(policy, Forever(2), Seeds(0), max_steps=8)[0].tolist() == [5.0, 8.0]


def test_the_limit_counts_environment_steps_not_decisions():
    class Choice(ScriptedPolicy):
        """Takes the call of 10 steps, which pays 3."""

    policy = Choice(lambda obs: np.ones(len(obs), np.int64))
    assert first_episodes(policy, Calls(1), Seeds(0), max_steps=25)[0].tolist() == [9.0]


def test_equal_seeds_give_equal_starts_and_others_other_ones():
    env, wrong = Identity(50), ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64))
    first, again, other = (first_episodes(wrong, env, Seeds(s))[0] for s in (1, 1, 2))
    assert first.tolist() == again.tolist() != other.tolist()


def test_an_evaluation_is_made_once_in_every_so_many_steps_also_after_a_resume():
    policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64))
    evaluation = PeriodicEvaluation(lambda n, gamma: Countdown(n), 0.9, Seeds(0), 100, 3)
    evaluation.start(250)
    ticks = (260, 299, 300, 350, 520, 599, 601)
    assert [t for t in ticks if evaluation.due(t, lambda: policy)] == [300, 520, 601]
    assert evaluation.due(700, lambda: policy) == {"eval_return": 5.0, "eval_return_min": 5.0}
    never = PeriodicEvaluation(lambda n, gamma: Countdown(n), 0.9, Seeds(0), None, 3)
    assert never.due(10**6, lambda: policy) == {}


class Balance(Skill):
    """Stay up."""


SMALL = Network((8,), "relu")


@pytest.mark.parametrize(
    "algorithm",
    [PPO(num_envs=4, n_steps=16, batch_size=32, network=SMALL),
     DQN(num_envs=4, learning_starts=100, batch_size=8, network=SMALL)],
)  # fmt: skip
def test_a_run_is_evaluated_at_every_level_and_that_changes_nothing(tmp_path, algorithm):
    weights = []
    for every in (1000, None):
        hierarchy = Hierarchy(
            "CartPole-v1", [Balance()], algorithm=algorithm, selector=algorithm, call_steps=5,
            skill_steps=2200, selector_steps=2200, eval_every=every, eval_episodes=3,
        )  # fmt: skip
        run = hierarchy.train(tmp_path / str(every), quiet=True)
        lines = list(RunDirectory.open(run.path).metrics())
        for stage in ("balance", "selector"):
            seen = [m["steps"] // 1000 for m in lines if m["stage"] == stage and "eval_return" in m]
            assert seen == ([1, 2] if every else [])
            assert all(
                m["eval_return"] >= m["eval_return_min"] > 0 for m in lines if "eval_return" in m
            )
        weights.append(read_tensors(run.path / "policies" / "selector.safetensors")[0])
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(v, weights[1][k]) for k, v in weights[0].items())


def test_a_wrong_number_is_named():
    with pytest.raises(SkillweaveError, match="eval_every is 0"):
        Hierarchy("CartPole-v1", [Balance()], eval_every=0)
    with pytest.raises(SkillweaveError, match="eval_episodes is None"):
        Hierarchy("CartPole-v1", [Balance()], eval_episodes=None)
