"""Shuttle: the automaton's rewards and legs by hand, over positions that are written down."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from single_step import step_of
from toys import SideBySide

from benchmarks.pay.shuttle import POINTS, suite as shuttle_suite
from skillweave.recipes import _cheetah as cheetah, shuttle

COST = -0.25


class Runner(gym.Env):
    """Stands at 0, then where a list says; every action costs the same."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (18,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self, places):
        self.places = places

    def reset(self, *, seed=None, options=None):
        self.left = list(self.places)
        return self._obs(0.0), {}

    def step(self, action):
        x = self.left.pop(0)
        info = {"x_position": x, "reward_ctrl": COST}
        return self._obs(x), 99.0, False, not self.left, info

    def _obs(self, x):
        return np.array([x, *np.zeros(17)])


def run(points, places):
    """Rewards, and the leg after each step."""
    env = cheetah.Patrol(Runner(places), points)
    obs, _ = env.reset()
    assert obs.shape == (21,)
    assert obs[cheetah.LEG].tolist() == [1.0, 0.0, 0.0]
    rewards, legs = [], []
    for _ in places:
        obs, reward, *_ = env.step(np.zeros(6))
        rewards.append(reward)
        legs.append(int(obs[cheetah.LEG].argmax()))
        assert obs[cheetah.LEG].sum() == 1.0
    return rewards, legs


PAYS = 1000.0
ROUNDS = {
    # The point itself is not beyond it. The step that pays costs no effort, as in the paper.
    "the paper's": (
        (2.0, -2.0),
        [1.0, 2.0, 2.1, 5.0, -2.0, -2.1, -3.0, 3.0, -9.0],
        [COST, COST, COST, COST, COST, PAYS, COST, COST, PAYS],
        [0, 0, 1, 1, 1, 0, 0, 1, 0],
    ),
    "it begins beyond a point of a later leg, which has to wait": (
        (2.0, -2.0),
        [-3.0, -3.0, 3.0],
        [COST, COST, COST],
        [0, 0, 1],
    ),
    "each of three points is passed in its direction": (
        (2.0, 6.0, -2.0),
        [3.0, 5.0, 7.0, 1.0, -3.0, 3.0],
        [COST, COST, COST, COST, PAYS, COST],
        [1, 1, 2, 2, 0, 1],
    ),
    "one step passes one point at most": ((2.0, 6.0, -2.0), [7.0, 7.0], [COST, COST], [1, 2]),
}


@pytest.mark.parametrize("name", ROUNDS)
def test_a_round_pays_a_thousand_at_its_end_and_nothing_between(name):
    points, places, rewards, legs = ROUNDS[name]
    assert run(points, places) == (rewards, legs)


def seen(x, leg):
    """An observation at 2 m/s."""
    return np.array([[x, *np.zeros(8), 2.0, *np.zeros(8), *(np.arange(3) == leg)]], np.float32)


def test_skills_are_paid_for_speed_less_effort_and_for_the_end_of_a_leg():
    pushes = np.full(6, 0.5)  # the effort is 0.1·6·0.5² = 0.15
    going = step_of(seen(1.0, 0), seen(1.1, 0), pushes)
    assert shuttle.Forward().reward(going) == pytest.approx(2.0 - 0.15, abs=1e-4)
    assert shuttle.Backward().reward(going) == pytest.approx(-2.0 - 0.15, abs=1e-4)
    assert shuttle.Stop().reward(going) == pytest.approx(-2.0 - 0.15, abs=1e-4)
    assert not shuttle.Forward().termination(going)
    there = step_of(seen(1.95, 0), seen(2.05, 1), pushes)
    # The prize is 400, less 80 for each of the 2 m/s.
    assert shuttle.Forward().reward(there) == pytest.approx(1.85 + 240.0, abs=1e-2)
    assert shuttle.Forward().termination(there)


def test_the_half_cheetah_itself_has_the_papers_observations_rewards_and_length():
    pytest.importorskip("mujoco")
    env = cheetah.spec().make()
    obs, _ = env.reset(seed=3)
    assert obs.shape == (21,)
    action = np.full(6, 0.5, np.float32)
    for i in range(1, 1001):
        obs, reward, terminated, truncated, info = env.step(action)
        point = (2.0, -2.0)[int(obs[cheetah.LEG].argmax())]
        away = info["x_position"] - point
        assert obs[cheetah.X] == pytest.approx(np.sign(away) * np.log1p(abs(away)), abs=1e-5)
        assert (truncated, terminated) == (i == 1000, False)
        if reward < 500:
            assert reward == pytest.approx(-0.15)  # 0.1·6·0.5²


def test_x_is_seen_from_the_point_that_is_run_to():
    env = cheetah.Patrol(Runner([1.0, 3.0, -1.0]), (2.0, -2.0))
    seen = [env.reset()[0], *(env.step(np.zeros(6))[0] for _ in range(3))]
    # 2 is run to from 0 and 1; from 3 and −1 it is −2. Seen is the logarithm of one metre more.
    metres = [-2.0, -1.0, 5.0, 1.0]
    by_hand = [-np.log(3.0), -np.log(2.0), np.log(6.0), np.log(2.0)]
    assert [obs[cheetah.X] for obs in seen] == pytest.approx(by_hand)
    assert cheetah.from_log(np.array([obs[cheetah.X] for obs in seen])) == pytest.approx(metres)


def test_a_pool_of_patrols_sees_and_pays_as_each_patrol_alone():
    points, places = (2.0, 6.0, -2.0), ([3.0, 7.0, -3.0, 3.0], [1.0, 3.0, 5.0, 7.0])
    pool = cheetah.Patrols(SideBySide([Runner(p) for p in places]), 2, points)
    alone = [cheetah.Patrol(Runner(p), points) for p in places]
    seen = pool.reset(np.arange(2))[0]
    np.testing.assert_array_equal(seen, [env.reset()[0] for env in alone])
    # The second environment stands still while the first does two steps, and begins anew.
    for ids in ([0], [0], [0, 1], [1], [0, 1]):
        obs, reward, _, truncated, _ = pool.step(np.zeros((len(ids), 6)), np.array(ids))
        for row, i in enumerate(ids):
            one = alone[i].step(np.zeros(6))
            np.testing.assert_array_equal(obs[row], one[0])
            assert (reward[row], truncated[row]) == (one[1], one[3])
    np.testing.assert_array_equal(pool.reset(np.array([0]))[0], [alone[0].reset()[0]])
    again = pool.step(np.zeros((2, 6)), np.arange(2))[0]
    np.testing.assert_array_equal(again, [env.step(np.zeros(6))[0] for env in alone])


def test_envpools_half_cheetah_moves_as_gymnasiums():
    pytest.importorskip("mujoco")
    pytest.importorskip("envpool")
    points = (0.02, -0.02)  # so near that legs are done
    pool, env, one = cheetah.many(2, 1, 3, points), cheetah.make(points), np.array([1], np.int32)
    pool.reset(np.arange(2, dtype=np.int32))
    env.reset()
    state = pool.pool.step(np.zeros((1, 6), np.float32), one)[0][0]  # in 64 bits, one step later
    env.unwrapped.set_state(state[:9], state[9:18])
    rng, legs = np.random.default_rng(0), set()
    for _ in range(60):
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        obs, reward, *_ = pool.step(action[None], one)
        ours = env.step(action)
        np.testing.assert_allclose(obs[0], ours[0], atol=1e-5)
        assert reward[0] == pytest.approx(ours[1], abs=1e-5)
        legs.add(int(obs[0][cheetah.LEG].argmax()))
    assert legs == {0, 1}


def test_what_is_declared():
    everything, declared = set(range(21)), shuttle.declare()
    assert everything - set(shuttle.RUNNER.network.sees) == set(range(21)[cheetah.LEG])
    assert shuttle.SELECTOR.network.sees is None
    assert declared.plain_agent().algorithm.network.sees is None
    # Its name says how x is seen, so that runs that saw metres are refused.
    assert declared.spec.name == "Shuttle(2, -2; log x)"
    (stage,) = declared.stages()  # calls by lot become few long before the end
    config = stage.config
    assert (config.epsilon, config.epsilon_final, config.epsilon_fraction) == (0.95, 0.05, 0.4)
    # The protocol trains in as many processes as the recipe.
    suite = shuttle_suite()
    ready = dict.fromkeys(("forward", "backward", "stop"), lambda obs: np.zeros((len(obs), 6)))
    found = [suite.hierarchy(suite.task(n), ready if i else None) for i, n in enumerate(POINTS)]
    assert [h.spec.workers for h in found] == [shuttle.COLLECTORS, 1, 1, 1]
    assert declared.spec.workers == shuttle.COLLECTORS == 2


@pytest.mark.parametrize("points", list(POINTS.values()))
def test_all_points_of_a_patrol_are_in_the_picture(points):
    seen = cheetah.camera(points)
    half = seen["distance"] * np.tan(np.radians(45.0 / 2.0)) * 640 / 240  # MuJoCo's angle of view
    low, high = seen["lookat"][0] - half, seen["lookat"][0] + half
    assert low < min(points) - 0.5
    assert high > max(points) + 0.5
