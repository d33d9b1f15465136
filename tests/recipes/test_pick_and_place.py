"""Pick and place: what pays, what ends an episode, what disturbs, and the skills' functions."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from single_step import step_of

from skillweave import Apart
from skillweave.recipes import _arm as world, pick_and_place as arm


class Distances(gym.Env):
    """The block's distance to the goal, from a list."""

    observation_space = gym.spaces.Dict({})
    action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def __init__(self, distances):
        self.distances = distances

    def reset(self, *, seed=None, options=None):
        self.left = list(self.distances)
        return self._obs(1.0), {}

    def step(self, action):
        return self._obs(self.left.pop(0)), -1.0, False, not self.left, {}

    def _obs(self, distance):
        return {
            "observation": np.zeros(25),
            "achieved_goal": np.array([distance, 0.0, 0.0]),
            "desired_goal": np.zeros(3),
        }


def play(distances):
    env = world.Place(Distances(distances))
    env.reset()
    found = []
    for _ in distances:
        found.append(env.step(np.zeros(4, np.float32)))
        if found[-1][2] or found[-1][3]:
            break
    return found


@pytest.mark.parametrize(
    ("distances", "steps", "won"),
    [
        ([0.2, *[0.04] * 6], 6, True),  # five steps at the goal
        ([0.04, 0.04, 0.04, 0.04, 0.06, 0.04, 0.04, 0.04, 0.04], 9, False),  # it flies past
        ([0.04] * 5, 5, True),  # in its last step: it has not run out of time
    ],
)
def test_five_steps_at_the_goal_pay_one_and_end_the_episode(distances, steps, won):
    told = play(distances)
    assert [r for _, r, *_ in told] == [0.0] * (steps - 1) + [float(won)]
    assert [t for _, _, t, *_ in told] == [False] * (steps - 1) + [won]
    assert told[-1][3] is not won
    assert told[-1][4].get("success", False) is won


def observation(
    gripper=(1.3, 0.7, 0.5), offset=(0.0, 0.0, -0.1), fingers=0.1, goal=(1.3, 0.7, 0.6)
):
    obs = np.zeros((1, 28), np.float32)
    obs[:, arm.GRIPPER], obs[:, arm.OFFSET], obs[:, arm.GOAL] = gripper, offset, goal
    obs[:, arm.BLOCK] = np.add(gripper, offset)
    obs[:, arm.FINGERS] = fingers / 2
    return obs


FAR = observation(offset=(0.1, 0.0, -0.1))
OVER = observation(offset=(0.01, 0.0, -0.1))
AROUND = observation(offset=(0.01, 0.0, -0.01))
HELD = observation(offset=(0.01, 0.0, -0.01), fingers=0.05)
SHUT = observation(offset=(0.1, 0.0, -0.1), fingers=0.05)  # on nothing


def test_the_rule_chooses_by_where_the_block_is():
    chosen = arm.rule(np.concatenate([FAR, OVER, AROUND, HELD, SHUT]))
    assert chosen.tolist() == ["above", "descend", "close", "carry", "above"]


def test_functions_move_towards_what_they_are_for():
    obs = observation(offset=(0.05, -0.2, -0.1))
    np.testing.assert_allclose(arm.above(obs), [[0.5, -1.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(arm.descend(obs), [[0.5, -1.0, -1.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(arm.close(obs), [[0.0, 0.0, 0.0, -1.0]], atol=1e-6)
    lifted = observation(offset=(0.0, 0.0, 0.0), goal=(1.35, 0.7, 0.9))
    np.testing.assert_allclose(arm.carry(lifted), [[0.5, 0.0, 1.0, -1.0]], atol=1e-5)


def test_recovering_is_paid_by_progress_to_the_block():
    before, after = observation(offset=(0.3, 0.4, 0.0)), observation(offset=(0.0, 0.2, 0.0))
    there = observation(offset=(0.0, 0.0, 0.0))
    comes, arrives, skill = step_of(before, after), step_of(after, there), arm.Recover()
    assert skill.reward(comes) == pytest.approx(10 * 0.3)
    assert skill.reward(arrives) == pytest.approx(10 * 0.2 + 1.0)
    assert skill.termination(arrives)
    assert not skill.termination(comes)


@pytest.fixture
def disturbed():
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium_robotics")

    def make(**within):
        none = {"slip": 0, "nudge": 0, "move": 0}
        env = world.make(world.Disturbances(**none | within))
        return env, env.reset(seed=1)[0]

    return make


STILL = np.array([0.0, 0.0, 0.0, 1.0], np.float32)


def test_a_nudge_moves_the_block_some_centimetres_and_leaves_it_on_the_table(disturbed):
    env, obs = disturbed(nudge=1)
    before = obs[arm.BLOCK]
    for _ in range(11):  # it happens in the first step, and no more
        obs, *_ = env.step(STILL)
    moved = np.linalg.norm(obs[arm.BLOCK][:2] - before[:2])
    assert 0.03 < moved < 0.15
    assert obs[arm.BLOCK][2] == pytest.approx(0.425, abs=0.01)  # on the table


def test_a_goal_moves_once_in_one_of_the_steps_that_are_named(disturbed):
    env, obs = disturbed(move=1)
    after, *_ = env.step(STILL)
    assert np.linalg.norm(after[arm.GOAL] - obs[arm.GOAL]) > 0.01
    env, _ = disturbed(move=4)
    moves = []
    for _ in range(12):
        env.reset()
        goals = [env.step(STILL)[0][arm.GOAL] for _ in range(8)]
        changes = [i + 1 for i in range(7) if (goals[i] != goals[i + 1]).any()]
        assert len(changes) <= 1  # none: it was in the first step
        moves += changes or [0]
    assert set(moves) <= {0, 1, 2, 3}
    assert len(set(moves)) > 1


def test_a_gripper_slips_once_after_it_has_taken_hold_and_drops_the_block(disturbed):
    env, obs = disturbed(slip=1)
    held, slips = [], []
    for _ in range(60):  # the rule lifts it, and again
        name = str(arm.rule(obs[None])[0])
        obs, _, placed, *_ = env.step(getattr(arm, name)(obs[None])[0])
        held.append(env.holds)
        slips.append(env.slipping)
        if placed:
            break
    first = held.index(True)
    assert not any(slips[: first + 1])
    # Five steps, the first of which is made when the counter stands at four.
    assert [s for s in slips if s] == [4, 3, 2, 1]
    assert slips[first + 1] == 4
    assert not all(held[first:])
    assert placed


def test_skills_may_start_where_they_make_sense():
    skills = arm.hierarchy.skills
    assert [s.name for s in skills] == ["above", "descend", "close", "carry", "recover"]
    allowed = [[bool(s.initiation(o)[0]) for s in skills] for o in (FAR, OVER, AROUND, HELD)]
    assert allowed == [
        [True, False, False, False, True],
        [True, True, False, False, True],
        [True, True, True, False, True],
        [False, False, True, True, False],
    ]


def test_calls_end_where_there_is_nothing_left_to_do():
    def ends(skill, after):
        step = step_of(FAR, after)
        return bool(skill.termination(step)[0]), bool(skill.success(step)[0])

    above, descend, close, carry, _ = arm.hierarchy.skills
    assert [ends(above, o) for o in (FAR, OVER)] == [(False, False), (True, True)]
    after = [ends(descend, o) for o in (FAR, OVER, AROUND)]
    assert after == [(True, False), (False, False), (True, True)]
    assert [ends(close, o) for o in (AROUND, HELD)] == [(False, False), (True, True)]
    assert [ends(carry, o) for o in (HELD, AROUND)] == [(False, False), (True, False)]


@pytest.mark.slow
@pytest.mark.parametrize("declare", [arm.declare, arm.anchored])
def test_a_selector_is_learnt_over_skills_with_and_without_the_tree_beside_it(declare, tmp_path):
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium_robotics")
    small = replace(arm.SELECTOR, num_envs=2, n_steps=64, update_epochs=1)
    found = declare(
        world.Disturbances(), selector=small, apart=Apart(skill_steps=256, selector_steps=256)
    )
    found.env = replace(found.spec, workers=1)
    found.skill("recover").policy = arm.above
    run = found.train(tmp_path / "run", quiet=True)
    assert ("guide" in run.info()["hierarchy"]) == (declare is arm.anchored)
    usage = run.evaluate(2).to_json()["skill_usage"]
    assert sum(usage.values()) == pytest.approx(1.0)
