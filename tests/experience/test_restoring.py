"""Collectors that are brought back stand where they stood, or begin anew and say where."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from reference_calls import POSITION, Counter, Left, Right, Zigzag, shy
from toy_acting import Again, Choices, Counts, Given, requests, step
from toys import alone_in, calling_in, skills_of

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError
from skillweave.skills import Skill

pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")


def equal(one, two):
    """Whether two collectors have found the same, and that is all there is."""
    assert one.batches.keys() == two.batches.keys()
    for path, batch in one.batches.items():
        assert batch.keys() == two.batches[path].keys()
        for name, x in batch.items():
            np.testing.assert_array_equal(x, two.batches[path][name])
    assert one.steps == two.steps
    np.testing.assert_array_equal(one.episodes, two.episodes)


class Aside(Skill):
    """May start to the left only, so it must be searched for."""

    max_steps = 6

    def initiation(self, obs):
        return obs[:, POSITION] <= -1


class Falling(Skill):
    """CartPole: may start where the pole leans to the right."""

    max_steps = 7

    def initiation(self, obs):
        return obs[:, 2] > 0.02


def engine_of(env, num_envs=3, engine="sync"):
    return make_engine(EnvSpec(env, engine=engine), num_envs, threads=1)


def of_skill(env=Again, skill=None, engine="sync", actions=3, reflexes=(), acting=Counts):
    def make():
        made = engine_of(env, engine=engine)
        return alone_in(made, acting(made.num_envs, actions), skill, reflexes)

    return make


def of_selector(greedy=True):
    def make():
        calls = skills_of(Left, Right, Zigzag, Counter, call_steps=5, greedy=greedy)
        return calling_in(engine_of(Again), Counts(3, 4), calls, keep_rewards=True)

    return make


KINDS = {
    "task": of_skill(),
    "skill": of_skill(skill=Left()),
    "skill with a search": of_skill(skill=Aside()),
    "skill with reflexes": of_skill(skill=Aside(), reflexes=(shy(),)),
    "CartPole": of_skill("CartPole-v1", Falling(), actions=2),
    "EnvPool": of_skill("CartPole-v1", Falling(), "envpool", 2),
    "selector": of_selector(),
    "selector of skills that sample": of_selector(greedy=False),
}


@pytest.mark.parametrize("rows", [1, 13])
@pytest.mark.parametrize("kind", KINDS)
def test_a_collector_that_is_restored_goes_on_bit_for_bit(kind, rows):
    if kind == "EnvPool":
        pytest.importorskip("envpool")
    first, again, asked = KINDS[kind](), KINDS[kind](), requests(rows)
    try:
        first.start(Seeds(3))
        for request in itertools.islice(asked, -(-40 // rows)):
            first.collect(request)
        state = {k: v.copy() for k, v in first.state().items()}
        assert not len(again.restore(state))
        again.start(Seeds(9))  # it is under way: nothing happens
        for request in itertools.islice(asked, -(-40 // rows)):
            equal(first.collect(request), again.collect(request))
        for name, kept in again.state().items():
            np.testing.assert_array_equal(kept, first.state()[name])
    finally:
        first.close()
        again.close()


class Moody(gym.Env):
    """Does not repeat itself: its observation is drawn from a stream that no seed begins anew."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float64)
    action_space = gym.spaces.Discrete(2)
    stream = np.random.default_rng(0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action):
        moody = bool(action)
        return np.array([self.stream.random() if moody else 0.5]), 1.0, False, False, {}


def given(env, num_envs=3, skill=None):
    collector = alone_in(engine_of(env, num_envs), Given(num_envs), skill)
    collector.start(Seeds(0))
    return collector


def test_environments_that_do_not_repeat_themselves_begin_anew_and_are_named():
    first, second = given(Moody), given(Moody)
    step(first, [0, 1, 0])
    assert second.restore(first.state()).tolist() == [1]
    assert second.obs[:, 0].tolist() == [0.5, 0.0, 0.5]
    assert second.kept["age"].tolist() == [1, 0, 1]
    assert second.kept["sums"][:, 0].tolist() == [1.0, 0.0, 1.0]


class Hasty(gym.Env):
    """Ends after two steps in every second process that plays it; it shows nothing of that."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float64)
    action_space = gym.spaces.Discrete(2)
    hurry = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1), {}

    def step(self, action):
        self.t += 1
        return np.zeros(1), 1.0, bool(Hasty.hurry and action and self.t == 2), False, {}


def test_an_episode_that_ends_early_when_it_is_played_again_begins_anew(monkeypatch):
    first, second = given(Hasty), given(Hasty)
    for _ in range(5):
        step(first, [0, 1, 0])
    monkeypatch.setattr(Hasty, "hurry", True)
    assert second.restore(first.state()).tolist() == [1]
    monkeypatch.setattr(Hasty, "hurry", False)
    assert step(second, [0, 0, 0]).batches[""]["terminated"].tolist() == [[False] * 3]
    assert second.state()["kept.age"].tolist() == [6, 1, 6]


@pytest.mark.parametrize("saves", [(), (3, 7, 8)])
def test_an_episode_that_nothing_ends_is_truncated_wherever_checkpoints_are_written(
    saves, monkeypatch
):
    monkeypatch.setattr("skillweave.envs.checked.LONGEST_EPISODE", 10)
    env, truncated = given(Moody, 2), []
    for at in range(25):
        rows = step(env, [0, 0]).batches[""]
        assert not rows["terminated"].any()
        truncated.append(bool(rows["truncated"].all()))
        if at in saves:
            env.state()
    assert [at for at, over in enumerate(truncated) if over] == [9, 19]
    assert env.state()["engine.length"].tolist() == [5, 5]


def test_the_steps_of_an_open_episode_count_on_after_a_resume(monkeypatch):
    monkeypatch.setattr("skillweave.envs.checked.LONGEST_EPISODE", 10)
    first, again = given(Moody, 2), given(Moody, 2)
    for _ in range(6):
        step(first, [0, 0])
    assert not len(again.restore(first.state()))
    truncated = [bool(step(again, [0, 0]).batches[""]["truncated"].all()) for _ in range(5)]
    assert truncated == [False, False, False, True, False]


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_changes_nothing(kind, monkeypatch):
    if kind == "EnvPool":
        pytest.importorskip("envpool")
    monkeypatch.setattr("skillweave.envs.envpool_engine.RENEW_AFTER", 30)
    monkeypatch.setattr("skillweave.envs.checked.LONGEST_EPISODE", 17)
    saving, other, asked = KINDS[kind](), KINDS[kind](), requests(5)
    for collector in (saving, other):
        collector.start(Seeds(5))
    for at, request in enumerate(itertools.islice(asked, 30)):
        if at % 3 == 1:
            saving.state()
        equal(saving.collect(request), other.collect(request))


def test_a_state_of_another_kind_of_collector_is_refused_by_the_name_of_an_array():
    first, other = KINDS["task"](), of_skill(acting=Choices)()
    first.start(Seeds(0))
    with pytest.raises(SkillweaveError, match=r"open episodes differ in 'player\.rnn'"):
        other.restore(first.state())
    first, other = KINDS["selector"](), KINDS["selector"]()
    first.start(Seeds(0))
    first.collect(next(iter(requests(3))))
    for name in ("kept.sums", "open.obs"):
        state = first.state()
        state[name] = state[name].astype(np.float16)
        says = f"{name.partition('.')[2]!r} of open episodes is"
        with pytest.raises(SkillweaveError, match=says):
            other.restore(state)
