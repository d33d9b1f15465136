"""Skills that can act already lead to where the one that is trained may start."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from toy_acting import Choices, requests
from toys import alone_in, skills_of

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError, TrainingError
from skillweave.experience import search
from skillweave.experience.search import Search, Starts
from skillweave.policies.core import World
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet

N = 3
X, T = range(2)


class Corridor(gym.Env):
    """A line of 1,000 places: to the right by action 1, back to the start by any other."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.t = 0
        return self._obs(), {}

    def _obs(self):
        return np.array([self.x, self.t], np.float32)

    def step(self, action):
        self.x = self.x + 1 if action == 1 else 0
        self.t += 1
        return self._obs(), float(self.x), self.t >= 60, False, {}


def always(action):
    spaces = Corridor.observation_space, Corridor.action_space
    return ScriptedPolicy(lambda obs: np.full(len(obs), action), *spaces)


class Forward(Skill):
    max_steps = 30
    policy = always(1)


class OnlyFar(Skill):
    """May start only where it is not needed."""

    policy = always(1)

    def initiation(self, obs):
        return obs[:, X] > 900


class Far(Skill):
    max_steps = 5

    def initiation(self, obs):
        return obs[:, X] >= 20


class Five(Skill):
    """Five steps forward."""

    max_steps = 5
    policy = always(1)


class Anywhere(Skill):
    max_steps = 7


def collector_of(
    *kinds, env=Corridor, skill=Far, start_calls=0, search_steps=None, episode_calls=1, **more
):
    starters = skills_of(*kinds) if kinds else None
    engine = make_engine(EnvSpec(env, engine="sync"), N)
    how = start_calls, search_steps, episode_calls
    found = alone_in(engine, Choices(N, 5), skill(), (), starters, *how, **more)
    found.start(Seeds(0))
    return found


def starts_of(collector, rows=900):
    found = collector.collect(next(requests(rows))).batches[""]
    before = np.concatenate([np.zeros((1, N), bool), found["valid"][:-1]])
    began = found["valid"] & (~before | (found["obs"][:, :, T] == 0))
    return found["obs"][began]


def test_it_is_led_to_where_it_may_start_and_only_its_own_rows_are_valid():
    collected = collector_of(Forward).collect(next(requests(200)))
    experience = collected.batches[""]
    valid = experience["valid"]
    assert valid.any(0).all(), "chance alone would need 5^20 tries"
    started = valid[1:] & ~valid[:-1]
    assert (experience["obs"][1:][started][:, X] >= 20).all()
    led = ~valid & (experience["obs"][:, :, X] < 20)
    assert (experience["next_obs"][led][:, X] == experience["obs"][led][:, X] + 1).all()
    assert collected.steps == 200 * N
    # After each of its ends an episode begins anew, and it is led again.
    ends = valid & (experience["terminated"] | experience["truncated"])
    assert ends.sum() >= 2 * N
    assert all(experience["obs"][t + 1, n, T] == 0 for t, n in np.argwhere(ends[:-1]))


@pytest.mark.slow
def test_where_no_starter_may_start_chance_acts(monkeypatch):
    monkeypatch.setattr(search, "PATIENCE", 700)
    collector, asked = collector_of(OnlyFar), requests(600)
    first = collector.collect(replace(next(asked), record=("env_action",))).batches[""]
    assert len(np.unique(first["env_action"][~first["valid"]])) == 5
    with pytest.raises(SkillweaveError, match="steps of calling 'only_far'"):
        collector.collect(next(requests(1_000)))


@pytest.mark.parametrize(
    ("kinds", "how", "says"),
    [
        ((), {}, "steps of random acting"),
        (
            (Five, OnlyFar),
            {"skill": Anywhere, "after": ("only_far",)},
            "is to start after a call of 'only_far'",
        ),
    ],
)
def test_a_search_that_finds_nothing_says_so(kinds, how, says, monkeypatch):
    monkeypatch.setattr(search, "PATIENCE", 600)
    collector = collector_of(*kinds, **how)
    with pytest.raises(TrainingError, match=says):
        collector.collect(next(requests(800)))


@pytest.mark.slow
@pytest.mark.parametrize(("kinds", "skill"), [((Five,), Anywhere), ((Five,), Far)])
def test_a_number_of_calls_comes_first_and_each_number_is_as_likely(kinds, skill):
    calls = starts_of(collector_of(*kinds, skill=skill, start_calls=6), 3_000)[:, X] / 5
    least = 4 if skill is Far else 0  # it may start at 20, after four calls
    counts = np.array([np.mean(calls == k) for k in range(7)])
    expected = np.where(np.arange(7) < least, 0, 1 / 7)
    expected[least] += least / 7
    np.testing.assert_allclose(counts, expected, atol=0.05)
    assert counts.sum() == 1.0


@pytest.mark.slow
def test_an_episode_in_which_it_may_not_start_begins_anew(monkeypatch):
    monkeypatch.setattr(search, "PATIENCE", 900)
    found = collector_of(search_steps=9).collect(next(requests(200))).batches[""]
    assert not found["valid"].any()
    assert set(np.unique(found["obs"][:, :, T])) == set(range(9))
    # The step that leads there counts still, and who has started is not disturbed.
    found = collector_of(Forward, search_steps=20).collect(next(requests(200))).batches[""]
    assert set(np.unique(found["obs"][:, :, T][found["valid"]])) == set(range(20, 25))
    with pytest.raises(SkillweaveError, match=r"reset after 19 of them \(search_steps\)"):
        collector_of(Forward, search_steps=19).collect(next(requests(1_000)))


def test_where_it_may_start_the_calls_that_come_first_take_their_time():
    collector = collector_of(Five, skill=Anywhere, start_calls=6, search_steps=3)
    assert set(np.unique(starts_of(collector, 1_000)[:, X] / 5)) == set(range(7))


def test_chance_is_asked_only_where_no_starter_acts(monkeypatch):
    drawn = []

    def watched(space, n, rng, mask=None):
        drawn.append((n, None if mask is None else mask.tolist()))
        return np.full(n, 4)

    monkeypatch.setattr("skillweave.experience.search.random_actions", watched)
    skills = Forward(), OnlyFar()
    policies = tuple(skill.policy for skill in skills)

    def acted(kinds, xs, ids):
        starts = Starts(SkillSet(skills[kinds], policies[kinds]))
        engine: Any = SimpleNamespace(num_envs=len(xs), action_space=Corridor.action_space)
        obs = np.array([[x, 0] for x in xs], np.float32)
        mask = np.eye(5, dtype=bool)[[1, 2, 1, 3]] | np.eye(5, dtype=bool)[1]
        world = World(np.random.default_rng(0))
        return Search(Far(), starts, engine).act(np.array(ids), obs, mask, world).tolist()

    far_only, both = slice(1, 2), slice(0, 2)
    assert acted(both, [0, 0, 950, 0], [0, 2, 3]) == [1, 1, 1]
    assert not drawn
    assert acted(far_only, [0, 0, 950, 0], [1, 2, 3]) == [4, 1, 4]
    allowed = [[False, True, True, False, False], [False, True, False, True, False]]
    assert drawn == [(2, allowed)]
    assert acted(far_only, [0, 0, 0, 0], [2]) == [4]


@pytest.mark.slow
def test_an_episode_may_have_several_calls_with_those_of_others_between_them():
    collector = collector_of(Five, skill=Anywhere, start_calls=2, episode_calls=3)
    found = collector.collect(next(requests(1_200))).batches[""]
    for n in range(N):
        clock, valid = found["obs"][:, n, T], found["valid"][:, n]
        ends = np.flatnonzero(valid & found["truncated"][:, n])
        starts = [0, *np.flatnonzero(clock[1:] == 0) + 1]
        calls = [int(((ends >= a) & (ends < b)).sum()) for a, b in itertools.pairwise(starts)]
        assert set(calls) == {3}, "three calls of 7 and at most six of 5 fit into 60 steps"
        gaps = [int(valid[t + 1 :].argmax()) for t in ends[:-1] if clock[t + 1] > 0]
        assert set(gaps) == {0, 5, 10}


class Bounded(Corridor):
    """It ends by its time limit."""

    def step(self, action):
        obs, reward, over, _, info = super().step(action)
        return obs, reward, False, over, info


@pytest.mark.parametrize("max_steps", [25, 30])
@pytest.mark.parametrize("env", [Corridor, Bounded])
def test_no_call_is_left_over_where_the_environments_own_episode_ends(env, max_steps):
    class Long(Skill):
        pass

    Long.max_steps = max_steps
    found = collector_of(env=env, skill=Long, episode_calls=9).collect(next(requests(400)))
    clock = found.batches[""]["obs"][:, 0, T]
    over = found.batches[""]["truncated"][:, 0] | found.batches[""]["terminated"][:, 0]
    ends = [24, 49, 59] if max_steps == 25 else [29, 59]
    assert clock[over][: 2 * len(ends)].tolist() == 2 * ends
    by_itself = found.batches[""]["terminated"][:, 0][over]
    assert by_itself[: len(ends)].tolist() == [False] * (len(ends) - 1) + [env is Corridor]
    assert clock.max() == 59


class OnTime(Skill):
    """May start at a reset, and again at 15 and 30."""

    max_steps = 5

    def initiation(self, obs):
        return obs[:, T] % 15 == 0


@pytest.mark.slow
@pytest.mark.parametrize(("start_calls", "ends"), [(0, {4}), (2, {4, 19, 34})])
def test_after_a_call_it_is_called_again_only_where_the_calls_between_lead_to(start_calls, ends):
    how = {"start_calls": start_calls, "episode_calls": 3, "search_steps": 9}
    found = collector_of(Five, skill=OnTime, **how).collect(next(requests(800))).batches[""]
    at = found["obs"][:, :, T][found["valid"] & found["truncated"]]
    assert set(at) == ends


def test_a_skill_that_may_start_at_a_reset_alone_does_not_wait_for_ever():
    class Endless(Corridor):
        def step(self, action):
            obs, reward, _, _, info = super().step(action)
            return obs, reward, False, False, info

    class AtReset(Skill):
        max_steps = 5

        def initiation(self, obs):
            return obs[:, T] == 0

    collector = collector_of(Five, env=Endless, skill=AtReset, episode_calls=8)
    assert collector.collect(next(requests(600))).batches[""]["valid"].mean() > 0.8


def test_an_evaluated_episode_is_its_first_call():
    class Second(Skill):
        max_steps = 7

        def reward(self, step):
            return step.obs[:, T] == 10

    collector = collector_of(skill=Second, episode_calls=4)
    told = collector.collect(next(requests(400))).episodes[:, 0]
    assert set(told[:4]) | set(told) == {0.0, 1.0}
    played = collector.play(next(requests(1)), Seeds(0), 100)
    assert played[:, 0].tolist() == [0.0] * N
    assert played[:, 2].tolist() == [7.0] * N


class Back(Skill):
    """One step back to the start."""

    max_steps = 1
    policy = always(0)


def named(start_calls=0, kinds=(Five, Back), after=("five",)):
    return collector_of(*kinds, skill=Anywhere, start_calls=start_calls, after=after)


def test_half_of_the_episodes_start_after_a_call_of_a_named_skill():
    starts = starts_of(named())
    assert set(starts[:, X]) == {0, 5}
    assert abs(np.mean(starts[:, X] == 5) - 0.5) < 0.12
    # Calls at random may come before the named one.
    ages = {(int(x), int(t)) for x, t in starts_of(named(start_calls=1))}
    assert ages == {(0, 0), (0, 1), (5, 5), (5, 6), (10, 10)}


BETWEEN = {"kinds": (Five,), "skill": Anywhere, "start_calls": 2, "episode_calls": 3}
NAMED = {"kinds": (Five, Back), "skill": Anywhere, "start_calls": 2, "after": ("five",)}


@pytest.mark.parametrize(
    ("how", "rows"),
    [
        ({}, 7),  # in the middle of a starter's call
        ({}, 50),
        ({"start_calls": 3}, 7),
        ({"start_calls": 3}, 50),
        ({"start_calls": 3, "search_steps": 23}, 7),
        (BETWEEN, 5),  # between calls of one episode
        (BETWEEN, 9),
        (NAMED, 7),  # before a named call
        (NAMED, 50),
    ],
)
def test_one_that_is_restored_goes_on_the_same(how, rows):
    def make():
        more = {k: v for k, v in how.items() if k != "kinds"}
        return collector_of(*how.get("kinds", (Forward,)), **more)

    first, asked = make(), requests(rows)
    for request in itertools.islice(asked, 3):
        first.collect(request)
    again, kept = make(), first.state()
    assert not len(again.restore(kept))
    assert how is not BETWEEN or kept["kept.calls_made"].any()
    for request in itertools.islice(asked, 9):
        one, two = first.collect(request).batches[""], again.collect(request).batches[""]
        for name in ("obs", "action", "reward", "next_obs", "valid", "terminated", "truncated"):
            np.testing.assert_array_equal(one.get(name), two.get(name))
    # One over other environments keeps the same.
    other = first.like(first.engine, first.acting)
    assert {k: v.shape for k, v in other.kept.items()} == {
        k: v.shape for k, v in first.kept.items()
    }
