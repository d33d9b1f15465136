"""The critic of skills sees the goal of a call: it interrupts calls, and gives the task's part."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from small_runs import goes_on
from worlds import OFTEN, SELECTOR, SMALL, SPACES, Point, Rest, declared, go_to

import skillweave as sw
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.config import SkillCritic
from skillweave.policies.core import RowPolicy
from skillweave.policies.hierarchy import CallAndReturn, CalledSkill
from skillweave.skills.goal_spaces import draw_from, with_goal
from skillweave.skills.goals import goals_of

TOGETHER = {"selector": SELECTOR, "learn": "together", "train_defaults": OFTEN}


def random_critic(space, goals: dict[str, Any], **how) -> AgentPolicy:
    seen = with_goal(space, gym.spaces.Dict(list(goals.items())))
    settings = SkillCritic(network=SMALL, sees_goals=True, deciding=True, normalize_obs=False)
    algorithm = make_algorithm(settings, seen, gym.spaces.Discrete(2))
    policy = AgentPolicy.of(algorithm, algorithm.init([Seeds(0)]))
    noise = torch.Generator().manual_seed(0)
    weights = {
        k: v + 0.5 * torch.randn(v.shape, generator=noise) for k, v in policy.weights.items()
    }
    return AgentPolicy(algorithm, weights)


def of_skills(goals: dict[int, Any]) -> CallAndReturn:
    skills = (
        CalledSkill(of.skill.name, of.skill.name, RowPolicy(), goals=of) for of in goals.values()
    )
    return CallAndReturn(None, tuple(skills))


@pytest.mark.parametrize("space", ["box", "number", "dict", "picture"])
def test_what_a_skill_is_worth_depends_on_its_goal_and_a_decision_does_not(space):
    critic = random_critic(Point.observation_space, {"go_to": SPACES[space]})
    goals = goals_of(go_to(space))
    assert goals is not None
    values = draw_from(SPACES[space], 20, np.random.default_rng(0))
    obs = np.tile(np.float32([0.3, -0.4]), (20, 1))
    seen = of_skills({0: goals}).beside_calls(obs, np.zeros(20, int), {0: values})
    worth = critic.heads(seen)
    assert worth.shape == (20, 3)
    assert len(np.unique(worth[:, 0].round(4))) > 1
    np.testing.assert_allclose(worth[:, 2], worth[0, 2], rtol=1e-5)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("learn", "space"), [("together", "box"), ("apart", "number"), ("together", "bits")]
)
def test_interruption_with_goals_is_trained_and_resumed(learn, space, tmp_path):
    how = TOGETHER | {"learn": learn, "together": sw.Together(interrupt=True, margin=0.01)}

    def hierarchy():
        return declared([Rest(), go_to(space)], steps=600, **how)

    run = goes_on(hierarchy, tmp_path)
    critic = run.policy.skills.interruption.critic
    assert critic.observation_space["goal"]["go_to"] == SPACES[space]
    before = run.evaluate(3)
    again = sw.load(run.path, hierarchy()).evaluate(3)
    assert again.returns == before.returns


def test_a_skill_with_goals_follows_the_task_too():
    def trained(weight):
        hierarchy = declared([go_to(task_weight=weight), Rest()], steps=300, **TOGETHER)
        run = hierarchy.train(seed=1, quiet=True)
        return run.policy.skills.policies[0].weights

    own, both, again = (trained(weight) for weight in (0.0, 2.0, None))
    assert any(not torch.equal(own[k], both[k]) for k in own)
    assert any(not torch.equal(own[k], again[k]) for k in own)  # Together.task_weight


@pytest.mark.parametrize(
    ("as_dict", "own", "below", "seen"),
    [
        (False, (1,), None, (1, 2, 3)),
        (True, "place", ("observation.place", "goal"), ("observation.place", 2, 3)),
    ],
)
def test_the_critic_of_a_network_that_sees_a_part_sees_goals_too(as_dict, own, below, seen):
    selector, skill = (
        sw.PPO(num_envs=4, n_steps=64, network=sw.Network(hidden=(8,), sees=sees))
        for sees in (own, below)
    )
    how = TOGETHER | {"selector": selector, "together": sw.Together(interrupt=True)}

    def made():
        env = sw.EnvSpec(lambda: Point(as_dict=as_dict), workers=1)
        return declared([Rest(), go_to(algorithm=skill)], env=env, steps=300, **how)

    run = made().train(quiet=True)
    critic = run.policy.skills.interruption.critic.algorithm.config.network
    assert critic.sees == seen
    assert made().load(run.path).evaluate(3).returns == run.evaluate(3).returns
