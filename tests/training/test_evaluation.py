"""Evaluation equals a scalar loop from the same seeds, and its numbers are those of a hand."""

import dataclasses
import json
import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from toys import network_of

from skillweave import EnvSpec, Skill, SkillweaveError, evaluate
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.envs import checked, envpool
from skillweave.errors import PolicyError
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.training.evaluation import FIRST_SEED, interquartile_mean
from skillweave.types import Evaluation

torch.set_num_threads(1)


def spaces(env_id: str) -> tuple:
    env = gym.make(env_id)
    return env.observation_space, env.action_space


def agent(env_id: str) -> AgentPolicy:
    return network_of(*spaces(env_id))


def lander() -> ScriptedPolicy:
    function = lambda obs: np.where(obs[:, 3] < -0.3, 2, np.where(obs[:, 4] > 0.1, 3, 0))  # noqa: E731
    return ScriptedPolicy(function, *spaces("LunarLander-v3"))


def scalar(policy, make, seeds) -> tuple[list[float], list[int]]:
    """One environment, one episode after the other."""
    env, returns, lengths = make(), [], []
    for seed in seeds:
        obs, _ = env.reset(seed=seed)
        rewards, over = [], False
        while not over:
            action, _ = policy.act({}, obs[None])
            obs, reward, terminated, truncated, _ = env.step(action[0])
            rewards.append(float(np.float32(reward)))
            over = terminated or truncated
        returns.append(math.fsum(rewards))
        lengths.append(len(rewards))
    return returns, lengths


CASES = {
    "a network on CartPole": ("CartPole-v1", agent, {"max_episode_steps": 30}),
    "a script on LunarLander": ("LunarLander-v3", lambda _: lander(), {"max_episode_steps": 200}),
    "continuous actions": ("Pendulum-v1", agent, {"max_episode_steps": 20}),
}


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", [0, 3])
def test_returns_and_lengths_are_those_of_a_scalar_loop_from_the_same_seeds(case, seed):
    env_id, make, kwargs = CASES[case]
    policy, spec = make(env_id), EnvSpec(env_id, kwargs=kwargs)
    seeds = [1_000_000 * (seed + 1) + i for i in range(12)]
    returns, lengths = scalar(policy, lambda: gym.make(env_id, **kwargs), seeds)
    # networks multiply one row and five rows in another order: continuous actions differ in bits
    exact = case != "continuous actions"
    for num_envs in (5, 12, 100):
        found = evaluate(policy, spec, episodes=12, seed=seed, num_envs=num_envs)
        np.testing.assert_allclose(found.returns, returns, rtol=1e-12 if exact else 1e-4)
        assert list(found.lengths) == lengths
        assert len(set(found.returns)) > 3, "episodes are alike: the seeds say nothing"


@pytest.mark.parametrize("seed", [0, 10**12 - 1])
def test_in_a_pool_each_environment_plays_one_episode(seed):
    pytest.importorskip("envpool")
    n = 9
    policy, spec = agent("CartPole-v1"), EnvSpec("CartPole-v1")
    found = evaluate(policy, spec, episodes=n, seed=seed, num_envs=4, engine="auto")
    again = evaluate(policy, spec, episodes=n, seed=seed, engine="envpool")
    assert found == again, "it takes as many environments as there are episodes"

    pool = envpool("CartPole-v1", n, 1, FIRST_SEED * (seed + 1) % 2**30)
    obs, _ = pool.reset()
    lengths, open_ = np.zeros(n, int), np.ones(n, bool)
    while open_.any():
        action, _ = policy.act({}, obs)
        obs, _, terminated, truncated, _ = pool.step(action.astype(np.int32))
        lengths += open_
        open_ &= ~(terminated | truncated)
    assert list(found.lengths) == lengths.tolist() == list(found.returns)
    assert len(set(lengths)) > 3, "episodes are alike: the seed says nothing"
    assert evaluate(policy, spec, episodes=n, seed=seed + 1, engine="auto") != found


def test_where_there_is_no_pool_the_engine_makes_no_difference():
    made = []

    class Counted(gym.Wrapper):
        def __init__(self, env):
            super().__init__(env)
            made.append(self)

    wrapped = EnvSpec("CartPole-v1", wrappers=(Counted,))
    policy, how = agent("CartPole-v1"), {"episodes": 8, "num_envs": 3, "deterministic": False}
    found = []
    for engine in ("sync", "auto"):
        made.clear()
        found.append(evaluate(policy, wrapped, **how, engine=engine))
        assert len(made) < 8, "there are three, and those that are asked for spaces"
    assert found[0] == found[1]
    with pytest.raises(SkillweaveError, match="engine is 'fast'; it must be one of"):
        evaluate(policy, wrapped, engine="fast")


def test_no_episode_begins_that_nobody_asked_for():
    begun = []

    class Counted(gym.Wrapper):
        def reset(self, **how):
            begun.append(how["seed"])
            return super().reset(**how)

    spec = EnvSpec("CartPole-v1", wrappers=(Counted,))
    found = evaluate(agent("CartPole-v1"), spec, episodes=7, num_envs=3)
    assert len(set(found.lengths)) > 1, "they end one after the other"
    assert sorted(begun[:7]) == list(range(FIRST_SEED, FIRST_SEED + 7))
    assert begun[7:] == [FIRST_SEED], "whether an environment that was used starts it again"


def test_acting_by_sampling_is_reproduced_by_the_seed_and_differs_from_greedy():
    policy, spec = agent("CartPole-v1"), EnvSpec("CartPole-v1")

    def play(**how):
        return evaluate(policy, spec, episodes=8, num_envs=4, **how).returns

    assert play(deterministic=False) == play(deterministic=False)
    assert play(deterministic=False) != play()


# Skills ----------------------------------------------------------------------------------------


class Line(gym.Env):
    """Episode i (by seed) lasts 5 + i steps; the observation is the time; action a pays a."""

    observation_space = Box(-np.inf, np.inf, (1,), np.float32)
    action_space = Discrete(3)

    def reset(self, *, seed=None, options=None):
        if seed:
            self.length, self.truncates = 5 + (seed - FIRST_SEED), seed % 2 == 0
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        ended = self.t == self.length
        obs = np.array([self.t], np.float32)
        return obs, float(action), ended and not self.truncates, ended and self.truncates, {}


def fixed(action: int) -> ScriptedPolicy:
    return ScriptedPolicy(
        lambda obs: np.full(len(obs), action), Line.observation_space, Line.action_space
    )


class Short(Skill):
    max_steps = 2


class Long(Skill):
    max_steps = 9


class Never(Skill):
    pass


def woven() -> HierarchyPolicy:
    """Short where the time is a multiple of 5, else Long: calls of 2 and 3 steps by turns."""
    selector = ScriptedPolicy(
        lambda obs: (obs[:, 0] % 5 != 0).astype(int), Line.observation_space, Discrete(3)
    )
    policies = tuple(fixed(a) for a in (1, 2, 0))
    return HierarchyPolicy(selector, SkillSet((Short(), Long(), Never()), policies, call_steps=3))


@pytest.mark.parametrize("num_envs", [1, 2, 3, 4])
def test_steps_and_calls_of_each_skill_are_counted_exactly(num_envs):
    # episodes of 5, 6, 7 and 8 steps, in calls of 2 3 | 2 3 1 | 2 3 2 | 2 3 2 1 steps
    found = evaluate(woven(), EnvSpec(Line), episodes=4, num_envs=num_envs)
    assert found.lengths == (5, 6, 7, 8)
    assert found.returns == (2 + 6, 2 + 6 + 1, 2 + 6 + 2, 2 + 6 + 2 + 2)
    assert found.skill_steps == {"short": 2 + 3 + 4 + 4, "long": 3 + 3 + 3 + 4, "never": 0}
    assert found.skill_calls == {"short": 1 + 2 + 2 + 2, "long": 1 + 1 + 1 + 2, "never": 0}
    summary = found.to_json()
    assert summary["skill_usage"] == {"short": 13 / 26, "long": 13 / 26, "never": 0}
    assert summary["call_length_mean"] == {"short": 13 / 7, "long": 13 / 5}
    assert sum(found.skill_steps.values()) == sum(found.lengths)
    assert "short 50%, long 50%, never 0%" in str(found)


# Numbers ---------------------------------------------------------------------------------------


def test_the_interquartile_mean_by_hand():
    assert interquartile_mean(np.array([7.0])) == 7
    assert interquartile_mean(np.array([1.0, 3.0])) == 2
    # the middle half of 3 is 1.5 wide: a quarter of each end, and the middle one
    assert interquartile_mean(np.array([0.0, 6.0, 30.0])) == pytest.approx((6 + 30 / 4) / 1.5)
    assert interquartile_mean(np.array([100.0, 1.0, 3.0, -50.0])) == 2
    # of 5: three quarters of the second and fourth, and the third
    assert interquartile_mean(np.array([9, 0, 1, 2, 4])) == pytest.approx((0.75 + 2 + 3) / 2.5)
    assert interquartile_mean(np.arange(8.0) ** 2) == (4 + 9 + 16 + 25) / 4


def evaluation(returns, lengths=None, threshold=None) -> Evaluation:
    return Evaluation(tuple(returns), tuple(lengths or [1] * len(returns)), threshold)


def test_the_summary_by_hand():
    summary = evaluation((1.0, 2.0, 3.0, 6.0), (10, 20, 30, 60), threshold=3.0).to_json()
    std = math.sqrt((4 + 1 + 0 + 9) / 3)
    assert summary["std"] == pytest.approx(std)
    assert summary["ci95"] == pytest.approx([3 - 1.96 * std / 2, 3 + 1.96 * std / 2])
    assert {k: summary[k] for k in ("episodes", "mean", "median", "min", "max", "iqm")} == {
        "episodes": 4, "mean": 3.0, "median": 2.5, "min": 1.0, "max": 6.0, "iqm": 2.5,
    }  # fmt: skip
    assert (summary["length_mean"], summary["threshold"]) == (30, 3.0)
    assert summary["solved_fraction"] == 0.5, "the threshold itself is solved"
    one = evaluation((4.0,)).to_json()
    assert (one["mean"], one["std"], one["ci95"], one["iqm"]) == (4, 0, [4, 4], 4)


def test_the_summary_is_strict_json_and_the_line_says_it():
    found = evaluate(woven(), EnvSpec(Line), episodes=3)
    assert json.loads(json.dumps(found.to_json(), allow_nan=False)) == found.to_json()
    line = str(evaluation((100.0, 300.0), (50, 150), 200.0))
    assert "200.0 +/- 141.4 over 2 episodes" in line
    assert "50% at 200 or more" in line
    assert "100 steps an episode" in line
    # Small returns have digits enough to tell them apart.
    line = str(evaluation((0.96, 1.0)))
    assert "0.98 +/- 0.03 over 2 episodes (95 % CI 0.94 to 1.02, IQM 0.98)" in line
    assert "9.4 +/- 9.2 over 2 episodes" in str(evaluation((2.9, 15.9)))


def test_the_threshold_is_the_environments_own_and_without_one_nothing_is_solved():
    found = evaluate(agent("CartPole-v1"), EnvSpec("CartPole-v1"), episodes=2)
    assert found.threshold == 475
    assert found.solved_fraction == 0
    assert dataclasses.replace(found, returns=(475.0, 474.0)).solved_fraction == 0.5
    found = evaluate(fixed(1), EnvSpec(Line), episodes=2)
    assert found.threshold is None
    assert found.solved_fraction is None
    assert found.to_json()["solved_fraction"] is None
    assert "or more" not in str(found)


# Episodes that never end -----------------------------------------------------------------------


class Endless(Line):
    """Ends only where action 2 is taken; otherwise an action pays itself."""

    def step(self, action):
        obs, reward, *_, info = super().step(action)
        return obs, reward, bool(action == 2), False, info


def mixed(obs):
    """Ends the episodes that began first, after three steps; the others go on."""
    return np.where((np.arange(len(obs)) == 0) & (obs[:, 0] == 2), 2, 1)


def test_episodes_that_nothing_ends_are_cut_and_counted():
    for num_envs in (1, 2):
        found = evaluate(fixed(1), EnvSpec(Endless), episodes=3, num_envs=num_envs, max_steps=6)
        assert (found.lengths, found.returns, found.cut) == ((6,) * 3, (6.0,) * 3, 3)
        assert found.to_json()["cut"] == 3
        assert "3 never ended and were cut after 6 steps (max_steps)" in str(found)
    policy = ScriptedPolicy(mixed, Line.observation_space, Line.action_space)
    found = evaluate(policy, EnvSpec(Endless), episodes=2, num_envs=2, max_steps=5)
    assert (found.lengths, found.cut) == ((3, 5), 1)
    ends = evaluate(fixed(2), EnvSpec(Endless), episodes=2, max_steps=1)
    assert (ends.lengths, ends.cut) == ((1, 1), 0), "an end on the last step is an end"
    assert "cut" not in str(ends)


def test_without_a_limit_the_environments_own_counts_or_the_longest_episode(monkeypatch):
    monkeypatch.setattr(checked, "LONG_EPISODE", 9)
    assert evaluate(fixed(1), EnvSpec(Endless), episodes=1).lengths == (9,)
    limited = EnvSpec(lambda: gym.wrappers.TimeLimit(Endless(), 12))
    found = evaluate(fixed(1), limited, episodes=1)
    assert (found.lengths, found.cut) == ((12,), 0), "truncated by itself"


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"episodes": "x"}, "episodes is 'x'; it must be a whole number"),
        ({"seed": None}, "seed is None"),
        ({"seed": -1}, "seed is -1; it must be at least 0"),
        ({"seed": 10**30}, r"seed is 10+; it must be below 2\^63"),
        ({"max_steps": 0}, "max_steps is 0; it must be at least 1"),
        ({"num_envs": True}, "num_envs is True"),
    ],
)
def test_a_wrong_number_is_told(wrong, says):
    with pytest.raises(SkillweaveError, match=says):
        evaluate(fixed(0), EnvSpec(Line), **{"episodes": 1, **wrong})


# What is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("observation", "action", "says"),
    [
        (Box(-1, 1, (3,)), Discrete(2), r"observation_space Box.*\(3,\).*CartPole-v1 has Box"),
        (None, Discrete(3), r"action_space Discrete\(3\).*CartPole-v1 has Discrete\(2\)"),
    ],
)
def test_a_policy_made_for_other_spaces_is_told_both(observation, action, says):
    observation = observation or spaces("CartPole-v1")[0]
    policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), int), observation, action)
    with pytest.raises(PolicyError, match=says):
        evaluate(policy, EnvSpec("CartPole-v1"), episodes=1)


def test_evaluation_is_on_gymnasiums_environment_whatever_trains_it():
    pytest.importorskip("envpool")
    policy = agent("CartPole-v1")
    results = [
        evaluate(policy, EnvSpec("CartPole-v1", engine=engine), episodes=5)
        for engine in ("sync", "envpool")
    ]
    assert results[0] == results[1]
