"""Infos of several environments: a skill reads exactly what each environment gave."""

import json
from collections import Counter, OrderedDict

import gymnasium as gym
import numpy as np
import pytest
import torch
from timed import SMALL, Timed

import skillweave as sw
from skillweave.envs.make import make_engine
from skillweave.errors import SkillError
from skillweave.evolution import Evolution

READ: list[int] = []
"""Rows that a skill has read."""
ABSENT = type  # the same in every copy
"""Stands for a key that an environment does not give."""


class Telling(Timed):
    """Shows a number, and tells the value of that number in its info."""

    def __init__(self, values) -> None:
        self.values = values
        self.observation_space = gym.spaces.Box(0, len(values), (1,), np.float32)

    def show(self):
        self.i = int(self.np_random.integers(len(self.values)))
        return np.array([self.i], np.float32)

    def step(self, action):
        *step, _ = super().step(action)
        value = self.values[self.i]
        info = {} if value is ABSENT else {"told": value}
        return *step, {"always": self.i} | info


def telling(values) -> sw.EnvSpec:
    return sw.EnvSpec(lambda: Telling(values), workers=1)


def same(one, other) -> bool:
    if isinstance(other, np.ndarray):
        return np.shape(one) == other.shape and bool(np.all(np.asarray(one) == other))
    return bool(one == other)


class Reads(sw.Skill):
    max_steps = 5

    def __init__(self, values) -> None:
        super().__init__()
        self.values = values

    def reward(self, step):
        column = step.info.get("told")
        here = step.info.get("_told")
        for row, seen in enumerate(step.next_obs[:, 0]):
            value = self.values[int(seen)]
            if value is ABSENT:
                assert here is None or not here[row]
            else:
                assert same(column[row], value), (column, value)
                assert here[row]
                READ.append(row)
        np.testing.assert_array_equal(step.info["always"], step.next_obs[:, 0])
        return np.zeros(len(step.obs))


KINDS = {
    "int, then float": [0, 0.5],
    "bool, int, float": [True, 3, 0.25],
    "small and wide types": [np.float32(0.5), 0.1, np.int8(3), np.uint8(200)],
    "whole numbers beyond any type": [1, 2**70],
    "whole numbers that a float cannot hold": [0.5, 2**53 + 1],
    "a number or nothing": [1.5, None],
    "a number or a text": [0, "goal"],
    "only sometimes": [2.5, ABSENT],
    "arrays": [np.array([1, 2]), np.array([0.5, 2.0])],
    "arrays of several shapes": [np.array([1, 2]), np.array([1.0, 2.0, 3.0])],
    "an array or a number": [np.array([1, 2]), 7],
    "a list or a text": [[1, 2], "goal"],
    "arrays of dates and of numbers": [np.array(["2026-01-01"], "M8[D]"), np.array([3])],
    "arrays of records and of numbers": [np.array([(1, 2)], "i4,i4"), np.array([3.0])],
}


@pytest.mark.parametrize("values", KINDS.values(), ids=KINDS)
def test_each_environment_is_read_exactly(values):
    spec = telling(values)
    READ.clear()
    agents = {"algorithm": SMALL, "selector": SMALL}
    sw.Hierarchy(spec, [Reads(values)], steps=128, **agents).train(quiet=True)
    assert len(READ) > 50


def test_dicts_of_any_kind_are_read_by_their_keys():
    class Nested(sw.Skill):
        max_steps = 5

        def reward(self, step):
            np.testing.assert_array_equal(step.info["told"]["x"], step.next_obs[:, 0])
            READ.append(1)
            return step.info["told"]["x"]

    READ.clear()
    kinds = [OrderedDict(x=0), {"x": 1.0}, Counter(x=2)]
    agents = {"algorithm": SMALL, "selector": SMALL}
    sw.Hierarchy(telling(kinds), [Nested()], steps=256, **agents).train(quiet=True)
    assert READ


def test_members_of_a_population_may_tell_other_kinds():
    values = [0, 2**60 + 1, 0.5, {"a": 1}, np.arange(3), "goal", ABSENT]
    evolve = Evolution(population=2, generations=2)
    sw.train_agent(telling(values), SMALL, 1_500, evolve=evolve, quiet=True)


class Scores(sw.Skill):
    max_steps = 5

    def reward(self, step):
        return step.info["told"]


class Doubles(Scores):
    def reward(self, step):
        return 2 * step.info["told"]


@pytest.mark.parametrize(
    ("skill", "other"),
    [(Scores(), None), (Scores(), "goal"), (Doubles(), None), (Doubles(), {"goal": 1})],
)
def test_a_key_that_is_read_must_hold_numbers_in_all_environments(skill, other):
    spec = telling([1.5, other])
    with pytest.raises(SkillError) as caught:
        sw.Hierarchy(spec, [skill], steps=256, algorithm=SMALL, selector=SMALL).train(quiet=True)
    said = str(caught.value)
    assert "info['told'] is " in said
    assert f"{other!r} of environment" in said or "a dict of 'goal'" in said


def test_a_key_that_nobody_gives_is_named_after_a_while_or_at_the_end():
    def train(steps):
        how = {"steps": steps, "algorithm": SMALL, "selector": SMALL}
        sw.Hierarchy(telling([ABSENT]), [Scores()], **how).train(quiet=True)

    with pytest.raises(SkillError, match=r"no environment set this key .*'always'"):
        train(3_000)
    with pytest.warns(match=r"no environment set info\['told'\].*'always'"):
        train(256)


class Ends(Timed):
    """Tells its length and a text where an episode ends, and nothing before."""

    def step(self, action):
        *step, _ = super().step(action)
        over = step[-1] or step[-2]
        return *step, {
            "length": float(self.t),
            "why": "time",
            "of": {"t": [self.t]},
        } if over else {}


@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_key_of_some_steps_alone_is_nothing_elsewhere(num_envs, recwarn):
    paid, given = [], []

    class Counts(sw.Skill):
        max_steps = 30

        def reward(self, step):
            length, whys = step.info["length"], step.info["why"]
            given.append("length" in step.info)
            assert length.shape == step.reward.shape
            np.testing.assert_array_equal(step.info["_length"], length > 0)
            np.testing.assert_array_equal(step.truncated | step.terminated, length > 0)
            if given.count(True) and not given[-1]:
                assert all(why is None for why in whys)
                assert step.info["of"]["t"].tolist() == [None] * len(length)
                assert step.info.get("length") is None
            paid.append(length.sum())
            return length

        def termination(self, step):
            return step.info["length"] > 0

    ppo = sw.PPO(num_envs=num_envs, n_steps=32, batch_size=32)
    spec = sw.EnvSpec(Ends, workers=1)
    sw.Hierarchy(spec, [Counts()], steps=256, algorithm=ppo, selector=ppo).train(quiet=True)
    assert max(paid) > 0
    assert not [str(w.message) for w in recwarn if "info" in str(w.message)]


@pytest.mark.parametrize(
    "wrap",
    [
        lambda x: x,
        np.asarray,
        lambda x: np.array([x]),
        lambda x: np.array([[float(x)]]),
        torch.tensor,
        lambda x: torch.tensor([x], requires_grad=False),
        lambda x: torch.tensor([float(x)], requires_grad=True),
        lambda x: [x],
        lambda x: (np.asarray(x),),
        lambda x: [torch.tensor([x])],
    ],
)
def test_one_number_in_any_wrapping_is_a_success(wrap, tmp_path, recwarn):
    class Even(Timed):
        length = 4

        def reset(self, *, seed=None, options=None):
            found = super().reset(seed=seed)
            self.even = bool(self.np_random.integers(2))
            return found

        def step(self, action):
            *step, _ = super().step(action)
            return *step, {"success": wrap(self.even), "score": wrap(2.5)}

    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    one, several = (sw.evaluate(policy, Even, episodes=20, num_envs=n) for n in (1, 4))
    assert one.succeeded == several.succeeded
    assert one.succeeded in range(1, 20)
    assert one.succeeded == one.succeeded_once
    run = sw.train_agent(
        sw.EnvSpec(Even, workers=1), SMALL, 128, tmp_path / "run", log_info=["score"], quiet=True
    )
    last = json.loads((run.path / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["info/score"] == 2.5
    assert 0 < last["success"] < 1
    assert not [str(w.message) for w in recwarn if "success" in str(w.message)]


@pytest.mark.parametrize("odd", ["yes", np.array([True, False]), {"door": True}, object()])
def test_a_success_that_is_no_number_is_said(odd):
    class Odd(Timed):
        def step(self, action):
            *step, _ = super().step(action)
            return *step, {"success": odd}

    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    with pytest.warns(match=r"info\['success'\] is (of type|an array).*does not count"):
        assert sw.evaluate(policy, Odd, episodes=3).succeeded is None


@pytest.mark.parametrize("way", ["only where it is true", "not before the last step"])
def test_a_success_may_be_given_in_some_steps_alone(way):
    class Given(Telling):
        def __init__(self):
            super().__init__([0, 1])

        def reset(self, *, seed=None, options=None):
            found = super().reset(seed=seed)
            self.length = int(self.np_random.integers(3, 9))
            return found

        def step(self, action):
            obs, *_ = super().step(action)
            over = self.t == self.length
            wins = over and self.length > 5
            if way == "only where it is true":
                return obs, 1.0, over, False, {"success": True} if wins else {}
            return obs, 1.0, over, False, {"success": wins if over else None}

    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    for num_envs in (1, 3, 20):
        found = sw.evaluate(policy, Given, episodes=20, num_envs=num_envs)
        assert found.success_rate == np.mean(np.array(found.lengths) > 5)
        assert 0 < found.succeeded < 20


@pytest.mark.parametrize("key", ["TimeLimit.truncated", "time_outs"])
@pytest.mark.parametrize("wrap", [lambda x: x, lambda x: np.array([x]), torch.tensor])
def test_an_end_that_info_calls_a_time_limit_is_no_termination(key, wrap):
    class Old(Timed):
        length = 5

        def reset(self, *, seed=None, options=None):
            found = super().reset(seed=seed)
            self.fails = seed % 2
            return found

        def step(self, action):
            obs, reward, *_ = super().step(action)
            fell, limit = self.fails and self.t == 3, self.t == 5
            return obs, reward, bool(fell or limit), False, {key: wrap(bool(limit))}

    engine = make_engine(sw.EnvSpec(Old), 2)
    engine.reset_some(np.arange(2), [0, 1])
    for t in range(1, 6):
        ids = np.arange(2 if t < 4 else 1)
        step = engine.step(np.zeros(len(ids), int), ids)
        assert step.terminated.tolist() == ([False, t == 3] if t < 4 else [False])
        assert step.truncated.tolist() == ([False, False] if t < 4 else [t == 5])


class OneBuffer(Timed):
    """All its instances show the same array, which each of them fills in its own step."""

    shared = np.zeros(2, np.float32)
    length = 7

    def __init__(self, parts: bool) -> None:
        box = gym.spaces.Box(-1e6, 1e6, (2,), np.float32)
        self.parts = parts
        self.observation_space = (
            gym.spaces.Dict(own=box, t=gym.spaces.Discrete(100)) if parts else box
        )

    def show(self):
        if self.t == 0:
            self.number = int(self.np_random.integers(1000))
        self.shared[:] = self.number, self.t
        return {"own": self.shared, "t": self.t} if self.parts else self.shared

    def step(self, action):
        *step, _ = super().step(action)
        return *step, {"number": self.number, "t": self.t}


@pytest.mark.parametrize("parts", [False, True], ids=["box", "dict"])
def test_instances_may_share_one_buffer_for_observations(parts):
    seen = []

    class Watches(sw.Skill):
        max_steps = 5

        def reward(self, step):
            own = step.next_obs["own"] if parts else step.next_obs
            before = step.obs["own"] if parts else step.obs
            np.testing.assert_array_equal(own[:, 0], step.info["number"])
            np.testing.assert_array_equal(own[:, 1], step.info["t"])
            np.testing.assert_array_equal(before[:, 1], step.info["t"] - 1)
            seen.append(len(np.unique(own[:, 0])))
            return np.zeros(len(step.obs))

    spec = sw.EnvSpec(OneBuffer, kwargs={"parts": parts}, workers=1)
    sw.Hierarchy(spec, [Watches()], steps=256, algorithm=SMALL, selector=SMALL).train(quiet=True)
    assert max(seen) > 1
