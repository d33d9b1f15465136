"""A selector that starts from a plan, over skills that see and write parts alone."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from parts.crane import Arm, Crane, Hook, crane

import skillweave as sw
from skillweave.planning import Mission
from skillweave.spaces import obs_dtype

TASK = Mission(lambda obs: np.abs(obs["arm"]).max(axis=1) < 0.3)
QUICK = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=2)
GREEDY = sw.Selection(greedy_skills=True)


pytestmark = pytest.mark.filterwarnings("ignore:this plan has a chance")  # nothing has learnt


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr("skillweave.training.imitation.GRADIENT_STEPS", 50)
    monkeypatch.setattr("skillweave.planning.planned_run.PAIRS", 200)


def pushes(seen):
    """Return other pushes of the arm in each step, which only its start and steps decide."""
    return 0.3 * np.cos(7 * seen["arm"])


class Bends(sw.Skill):
    """Learns what to add to pushes, of which each is held for two steps."""

    sees, acts = {"arm": "arm"}, (2, 0)
    policy = sw.Residual(sw.from_function(pushes, every=2), scale=0.5)

    def reward(self, step: sw.Step):
        return -np.abs(step.next_obs["arm"]).sum(axis=1)


def own(kind: type[sw.Skill], **fields) -> sw.Skill:
    return type(kind.__name__, (kind,), fields)()


def nested() -> sw.Hierarchy:
    return crane([Hook()], name="inner", call_steps=2, rest="hold", env=SPEC)


SPEC = sw.EnvSpec(Crane, engine="sync", workers=1)
CASES = {
    "sees and acts": lambda: Arm(),
    "acts": lambda: own(Arm, sees=None),
    "sees": lambda: own(Arm, acts=None),
    "a function": lambda: own(Arm, policy=lambda seen: -0.3 * seen),
    "correction": Bends,
    "correction alone": lambda: own(Bends, sees=None, acts=None, policy=sw.Residual(whole)),
    "hierarchy": nested,
}


def plan(run):
    return run.plan(TASK, run.log_calls(200, num_envs=2), features=lambda obs: obs["arm"])


def whole(obs):
    return np.concatenate([pushes(obs), -obs["hook"]], axis=1)


@pytest.mark.filterwarnings("ignore:these skills have a memory")
@pytest.mark.fast_cases(3)
@pytest.mark.parametrize("make", CASES.values(), ids=CASES)
def test_skills_act_as_before(make):
    """Under a selector of one skill nothing else decides what is done."""
    skill = make()
    rest = {} if getattr(skill, "acts", None) is None else {"rest": ("hold", 0.25, 0.5)}
    run = crane([skill], env=SPEC, selection=GREEDY, **rest).train(quiet=True)
    planned = plan(run)
    after = planned.with_selector(QUICK, steps=64).train(quiet=True)
    env, first, second = after.hierarchy.spec.make(), run.player(), after.player()
    for seed in range(2):
        obs, _ = env.reset(seed=seed)
        first.reset(), second.reset()
        for _ in range(8):
            own = {k: v for k, v in obs.items() if k != "task"}
            action = first.act(own)
            np.testing.assert_array_equal(second.act(obs), action)
            obs, _, ended, *_ = env.step(action)
            if ended:
                break


def test_a_skill_with_a_part_keeps_its_goals():
    class Reach(Arm):
        goal_space = gym.spaces.Box(-1, 1, (2,), np.float32)

        def reward(self, step: sw.Step):
            return -np.abs(step.next_obs["arm"] - step.goal).sum(axis=1)

    run = crane([Reach(), Hook()], env=SPEC, selection=GREEDY).train(quiet=True)
    planned = plan(run)
    after = planned.with_selector(QUICK, steps=64).train(quiet=True)
    skill = after.policy.skills.policies[0]
    obs = np.zeros(2, obs_dtype(skill.observation_space))
    obs["goal"] = [[1, 1], [-1, -1]]
    actions, _ = skill.act({}, obs)
    assert actions.shape == (2, 2)
    assert np.abs(actions[0] - actions[1]).max() > 1e-4
