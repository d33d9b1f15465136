"""Functions whose answer for an environment depends on the rows of others are refused."""

from __future__ import annotations

import random
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.errors import PolicyError, SkillError, SkillweaveError
from skillweave.planning.predicates import Predicate
from skillweave.selectors.function import FunctionSelector
from skillweave.skills import Skill, asked
from skillweave.skills.base import Reflex
from skillweave.skills.goals import Goals
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.types import Step

PLACES = gym.spaces.Box(-1, 1, (2,))
OBS = np.random.default_rng(5).uniform(-1, 1, (40, 4)).astype(np.float32)
MODULES_RNG = np.random.default_rng(3)


def step(n: int = 5, seed: int = 0) -> Step:
    rng = np.random.default_rng(seed)
    obs, next_obs = rng.uniform(-1, 1, (2, n, 4)).astype(np.float32)
    never = np.zeros(n, bool)
    goal = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    info = {"height": rng.random(n), "name": np.array(["a"] * n), "level": 3}
    elapsed = np.arange(1, n + 1)
    return Step(
        obs, rng.random(n), next_obs, rng.random(n), never, never, never, elapsed, info, goal
    )


def skill(**methods: Any) -> Skill:
    kind = type("Go", (Skill,), {"goal_space": PLACES} | methods)
    made: Skill = kind()
    return made


REWARDS = {
    "the first goal": lambda _, step: -np.abs(step.next_obs[:, :2] - step.goal[0]).sum(axis=1),
    "the last goal": lambda _, step: step.next_obs[:, 0] * step.goal[-1, 0],
    "the first observation": lambda _, step: step.reward + step.next_obs[0, 2],
    "a norm over all": lambda _, s: s.reward - np.linalg.norm(s.next_obs[:, :2] - s.goal),
    "a mean over all": lambda _, step: step.next_obs[:, 0] - step.next_obs[:, 0].mean(),
    "the largest of all": lambda _, step: step.reward + step.next_obs.max(),
    "the info of the first": lambda _, step: step.reward + step.info["height"][0],
    "the time of the first": lambda _, step: step.reward * step.elapsed[0],
    "a running sum": lambda _, step: np.cumsum(step.reward),
}


@pytest.mark.parametrize("reward", REWARDS.values(), ids=REWARDS)
@pytest.mark.parametrize("n", [2, 5, 300])
def test_a_reward_of_rows_of_others_is_refused(reward: Any, n: int) -> None:
    message = (
        r"skill 'go': reward\(\) mixes up environments: .* row \d+ of \d+.*step\.goal\[:, 0\].*axis"
    )
    with pytest.raises(SkillError, match=message):
        asked(skill(reward=reward), "reward", step(n), n)


@pytest.mark.parametrize("method", ["termination", "success"])
def test_an_end_by_the_goal_of_another_is_refused(method: str) -> None:
    wrong = skill(**{method: lambda _, step: step.next_obs[:, 0] > step.goal[0, 0]})
    with pytest.raises(SkillError, match=rf"skill 'go': {method}\(\) mixes up environments"):
        asked(wrong, method, step(40), 40)


def test_an_initiation_by_the_place_of_another_is_refused() -> None:
    wrong = skill(initiation=lambda _, obs: obs[:, 0] > obs[0, 2])
    with pytest.raises(SkillError, match=r"initiation\(\) mixes up environments"):
        asked(wrong, "initiation", step(40).obs, 40)


def test_a_rare_success_by_the_goal_of_another_is_refused() -> None:
    """Nearly all calls answer no, with the own goal as with that of another."""

    def near(_: Any, step: Any) -> Any:
        return np.abs(step.next_obs[:, :2] - step.goal[0]).max(axis=1) < 0.1

    wrong = skill(success=near)

    def many_calls() -> None:
        for seed in range(2000):
            asked(wrong, "success", step(4, seed), 4)

    with pytest.raises(SkillError, match=r"success\(\) mixes up environments"):
        many_calls()


def test_a_condition_and_a_predicate_of_another_are_refused() -> None:
    with pytest.raises(SkillError, match=r"reflex 'low': condition\(\) mixes up environments"):
        Reflex(lambda obs: obs[:, 0] > obs[0, 1], action=1, name="low").holds(OBS)
    with pytest.raises(SkillError, match=r"task: far\(\) mixes up environments"):
        Predicate(lambda step: step.obs[:, 0] > step.obs[0, 1], "far", "step").holds(step(40))


def test_goals_that_are_the_same_for_all_by_mistake_are_refused() -> None:
    goals = Goals(skill(goals=lambda _, obs, rng: obs[:, :2] * 0.5 + obs[0, :2] * 0.5))
    with pytest.raises(SkillError, match=r"goals\(\) mixes up environments"):
        goals.draw(OBS, np.random.default_rng(0))
    clips = skill(clip_goal=lambda _, obs, goal: np.clip(goal, obs[0, :2] - 0.1, obs[0, :2] + 0.1))
    with pytest.raises(SkillError, match=r"clip_goal\(\) mixes up environments"):
        Goals(clips).fitted(OBS, OBS[:, 2:], "a test")


def by_name(obs: Any, goal: Any) -> Any:
    return obs[:, :2] - goal[0]


def second(obs: Any, place: Any) -> Any:
    return obs[:, :2] - place[0]


@pytest.mark.parametrize("function", [by_name, second])
def test_a_policy_that_takes_the_goal_of_another_is_refused(function: Any) -> None:
    space = gym.spaces.Dict({"observation": gym.spaces.Box(-9, 9, (4,)), "goal": PLACES})
    policy = ScriptedPolicy(function).bind_with_goals(
        space["observation"], gym.spaces.Box(-9, 9, (2,)), "a test", Goals(skill())
    )
    seen = np.zeros(40, [("observation", np.float32, 4), ("goal", np.float32, 2)])
    seen["observation"], seen["goal"] = OBS, OBS[:, 2:]
    with pytest.raises(PolicyError, match=r"mixes up environments"):
        policy.act({}, seen)


def test_actions_and_choices_by_the_place_of_another_are_refused() -> None:
    box = gym.spaces.Box(-9, 9, (2,))
    with pytest.raises(PolicyError, match=r"function <lambda>\(\) mixes up environments"):
        ScriptedPolicy(lambda obs: obs[:, :2] + obs[0, :2], action_space=box).act({}, OBS)
    reflex = Reflex(lambda obs: obs[:, 0] > -9, lambda obs: obs[:, :2] + obs[0, :2], "low")
    with pytest.raises(SkillError, match=r"reflex 'low': action\(\) mixes up environments"):
        reflex.apply(OBS, np.zeros((40, 2), np.float32), box)
    selector = FunctionSelector(lambda obs: np.where(obs[:, 0] > obs[0, 1], "left", "right"))
    with pytest.raises(SkillError, match=r"mixes up environments: it answers '?\w+'? for row"):
        selector.among(("left", "right")).act({}, OBS)


class Own:
    """A function with a state of its own, which changes its answers now and then."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, obs: Any) -> Any:
        self.calls += 1
        return obs[:, :2] + self.calls


RANDOM = {
    "global": lambda _, step: step.reward + np.random.rand(len(step.reward)),  # noqa: NPY002
    "for all": lambda _, step: step.reward + random.random(),
    "of a module": lambda _, step: step.reward + MODULES_RNG.random(),
}


@pytest.mark.parametrize("reward", RANDOM.values(), ids=RANDOM)
def test_random_functions_are_not_refused(reward: Any) -> None:
    for seed in range(20):
        np.random.seed(seed)  # noqa: NPY002
        asked(skill(reward=reward), "reward", step(3, seed), 3)


def test_random_goals_policies_and_states_are_not_refused() -> None:
    for seed in range(50):
        rng = np.random.default_rng(seed)
        drawn = Goals(skill(goals=lambda _, obs, rng: rng.uniform(-1, 1, (len(obs), 2))))
        drawn.draw(OBS[:2], rng)
        few = skill(goal_space=gym.spaces.Discrete(2), goals=lambda _, o, r: r.integers(2, size=2))
        with pytest.raises(SkillError, match=r"goals\(\) .*for 2 its shape was right by chance"):
            Goals(few).draw(OBS[:2], rng)
        few = skill(
            goal_space=gym.spaces.Discrete(2), goals=lambda _, o, r: r.integers(2, size=len(o))
        )
        Goals(few).draw(OBS[:2], rng)
    rare = ScriptedPolicy(
        lambda obs: (np.random.rand(len(obs), 2) < 0.05) * 1.0,  # noqa: NPY002
        action_space=gym.spaces.Box(-9, 9, (2,)),
    )
    for _ in range(2000):
        rare.act({}, OBS)
    policy = ScriptedPolicy(Own(), action_space=gym.spaces.Box(-9, 9, (2,)))
    for _ in range(20):
        policy.act({}, OBS)
    changing = skill(reward=lambda _, step: step.reward + step.reward.mean(), reward_changes=True)
    asked(changing, "reward", step(), 5)


RIGHT = {
    "its own": lambda _, step: -np.linalg.norm(step.next_obs[:, :2] - step.goal, axis=1),
    "time and info": lambda _, step: step.elapsed + step.info["height"] + step.info["level"],
    "of names": lambda _, step: (step.info["name"] == "a") * 1.0,
    "a product": lambda _, step: step.next_obs @ np.linspace(1e3, -1e3, 4, dtype=np.float32),
    "with a loop": lambda _, step: [float(row @ row) for row in step.next_obs],
}


@pytest.mark.parametrize("reward", RIGHT.values(), ids=RIGHT)
def test_rewards_of_their_own_rows_are_kept_and_no_stream_changes(reward: Any) -> None:
    np.random.seed(0)  # noqa: NPY002
    random.seed(0)
    right = skill(reward=reward)
    for n in (1, 2, 5, 300):
        expected = np.asarray(reward(right, step(n)), np.float32)
        assert asked(right, "reward", step(n), n).tolist() == expected.tolist()
    after = np.random.rand(), random.random()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    random.seed(0)
    assert after == (np.random.rand(), random.random())  # noqa: NPY002


def test_the_streams_of_modules_and_goals_do_not_change() -> None:
    before = MODULES_RNG.bit_generator.state
    asked(skill(reward=RANDOM["of a module"]), "reward", step(), 5)
    after = MODULES_RNG.bit_generator.state
    MODULES_RNG.bit_generator.state = before
    MODULES_RNG.random()
    assert after == MODULES_RNG.bit_generator.state
    one, other = np.random.default_rng(0), np.random.default_rng(0)
    drawn = skill(goals=lambda _, obs, rng: rng.uniform(-1, 1, (len(obs), 2)))
    first = Goals(drawn).draw(OBS, one)
    assert first.tolist() == other.uniform(-1, 1, (40, 2)).astype(np.float32).tolist()
    assert one.random() == other.random()


def test_rows_that_differ_later_are_compared_then() -> None:
    """At the first calls, environments may all be in the same place, or only one may act."""
    wrong = skill(reward=lambda _, step: step.next_obs[:, 0] - step.goal[0, 0])
    same = step(4)
    same = Step(**{name: _first(getattr(same, name)) for name in Step.__slots__})
    for _ in range(3):
        asked(wrong, "reward", step(1), 1)
        asked(wrong, "reward", same, 4)
        asked(wrong, "reward", same, 4)
    asked(wrong, "reward", step(4, 1), 4)  # the seventh call is not compared
    with pytest.raises(SkillError, match=r"mixes up environments"):
        asked(wrong, "reward", step(4, 1), 4)


def _first(value: Any) -> Any:
    return np.repeat(value[:1], 4, axis=0) if isinstance(value, np.ndarray) else {}


def test_training_says_so() -> None:
    class Reach(sw.Skill):
        goal_space = PLACES
        max_steps = 10

        def reward(self, step: sw.Step) -> Any:
            return -np.abs(step.next_obs[:, :2] - step.goal[0]).sum(axis=1)

    algorithm = sw.PPO(num_envs=4, n_steps=64, network=sw.Network(hidden=(8,)))
    declared = sw.Hierarchy(
        env="CartPole-v1", skills=[Reach()], steps=512, algorithm=algorithm, selector=algorithm
    )
    with pytest.raises(SkillweaveError, match=r"skill 'reach': reward\(\) mixes up environments"):
        declared.train("run", quiet=True)
