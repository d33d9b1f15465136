"""What a selector learns from beside its calls, which tests/calls has: γ, success, info, errors."""

import functools
import itertools

import gymnasium as gym
import numpy as np
import pytest
from reference_calls import Counter, Die, Left, Right, T, Walk, Zigzag
from toy_acting import Again, Choices, Given, requests
from toys import alone_in, calling_in, network_of, skills_of

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet

SPACES = Walk.observation_space, Walk.action_space
N, ALL = 4, (Left, Right, Zigzag, Counter)


skill_set = functools.partial(skills_of, call_steps=5)


def collector_of(skills, n=N, keep_rewards=False, env=Walk, acting=None, **spec):
    engine = make_engine(EnvSpec(env, engine="sync", **spec), n)
    acting = acting or Choices(n, len(skills.skills))
    found = calling_in(engine, acting, skills, keep_rewards)
    found.start(Seeds(7))
    return found


class Members(Choices):
    """As many members as environments, each with a γ of its own."""

    def __init__(self, num_envs, actions):
        super().__init__(num_envs, actions)
        self.each, self.members = 1, num_envs


def test_every_member_has_its_own_gamma_and_the_rewards_of_each_step_are_kept():
    skills, gamma = skill_set(*ALL, call_steps=40), np.linspace(0.5, 1.0, N)
    collector = collector_of(skills, keep_rewards=True, acting=Members(N, len(ALL)))
    for request in itertools.islice(requests(60, gamma), 3):
        found = collector.collect(request).batches[""]
        each = found["rewards"]
        assert each.shape[2] >= 13
        kept = gamma[:, None] ** np.arange(each.shape[2])
        np.testing.assert_allclose(found["reward"], (kept * each).sum(-1), atol=1e-5)
    plain = collector_of(skills).collect(next(requests(60))).batches[""]
    assert "rewards" not in plain


class Told(Again):
    """Tells whether an episode was a success, in odd episodes."""

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        if terminated or truncated:
            info["success"] = self.position > 0 if self.episode % 2 else None
        return obs, reward, terminated, truncated, info


@pytest.mark.parametrize("of_selector", [True, False])
def test_the_success_that_an_environment_tells_is_that_of_its_episode(of_selector):
    made = {}

    def make():
        made[len(made)] = Told()
        return made[len(made) - 1]

    if of_selector:
        collector = collector_of(skill_set(*ALL), env=make)
    else:
        engine = make_engine(EnvSpec(make, engine="sync"), N)
        collector = alone_in(engine, Choices(N, 3))
        collector.start(Seeds(7))
    kinds = set()
    for request in itertools.islice(requests(1), 90):
        before = {i: e.episode for i, e in made.items()}
        collected = collector.collect(request)
        ends = [i for i, e in made.items() if e.episode > before[i] and i >= len(made) - N]
        for told, i in zip(collected.episodes, ends, strict=True):
            logged = [a for e, _, a in made[i].log if e == before[i]]
            position = sum(logged) - len(logged)
            wanted = float(position > 0) if before[i] % 2 else np.nan
            np.testing.assert_array_equal(told[3], wanted)
            kinds.add(str(told[3]))
    assert kinds == {"0.0", "1.0", "nan"}


# What skills see -------------------------------------------------------------------------------


class Nested(gym.Env):
    """Tells a number of its own, which is its observation too, in three depths of info."""

    observation_space = gym.spaces.Box(0, 1 << 20, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.number = float(self.np_random.integers(1 << 20))
        return np.array([self.number], np.float32), {}

    def step(self, action):
        deep = {"id": self.number, "deeper": {"id": self.number}, "word": f"env {self.number}"}
        obs = np.array([self.number], np.float32)
        return obs, 0.0, False, False, {"id": self.number, "deep": deep}


@pytest.mark.usefixtures("no_trials")
@pytest.mark.usefixtures("unprobed")
def test_a_skill_sees_its_own_rows_of_info_however_deep():
    seen = []

    class Watching(Skill):
        policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64), None, None)

        def termination(self, step):
            seen.append((step.obs[:, 0].tolist(), step.info))
            return np.zeros(len(step.reward), bool)

    class Short(Skill):
        policy, max_steps = Watching.policy, 2

    acting = Given(4)
    acting.then = np.array([0, 1, 0, 1])
    collector = collector_of(skill_set(Short, Watching), env=Nested, acting=acting)
    collector.collect(next(requests(4)))
    assert len(seen) == 4
    for rows, info in seen:
        assert len(set(rows)) == 2
        deep = info["deep"]
        for found in (info["id"], deep["id"], deep["deeper"]["id"]):
            assert found.tolist() == rows
        assert list(deep["word"]) == [f"env {r}" for r in rows]


# What is wrong ---------------------------------------------------------------------------------


def test_where_no_skill_may_start_the_error_names_them_all():
    class Early(Left):
        def initiation(self, obs):
            return obs[:, T] < 1

    class Never(Left):
        def initiation(self, obs):
            return np.zeros(len(obs), bool)

    collector = collector_of(skill_set(Early, Never, call_steps=1))
    collector.collect(next(requests(1)))
    with pytest.raises(SkillweaveError, match=r"no skill may start .*'early', 'never'"):
        collector.collect(next(requests(1)))


def test_a_call_that_nothing_ends_is_told_and_not_waited_for(monkeypatch):
    monkeypatch.setattr("skillweave.experience.learners.LONGEST_EPISODE", 20)

    class Eternal(Left):
        max_steps = None

    skills = skill_set(Zigzag, Eternal, call_steps=None)
    acting = Given(2)
    acting.then = np.array([1, 1])
    collector, asked = collector_of(skills, 2, env=Nested, acting=acting), requests(10)
    collector.collect(next(asked))
    with pytest.raises(SkillweaveError, match="skill 'eternal' has run for 20 steps in environ"):
        collector.collect(next(asked))


def test_a_termination_that_is_no_flag_names_the_environment():
    class Half(Left):
        def termination(self, step):
            return np.full(len(step.reward), 0.5)

    acting = Given(3)
    acting.then = np.array([0, 0, 1])
    collector = collector_of(skill_set(Left, Half), 3, acting=acting)
    with pytest.raises(SkillweaveError, match=r"'half': termination\(\).* for environment 2,"):
        collector.collect(next(requests(1)))


# Skills that sample ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["scripted", "network"])
def test_what_skills_draw_follows_from_the_requests_seeds(kind):
    policies = (Die.policy if kind == "scripted" else network_of(*SPACES), Zigzag.policy)

    def play(first, greedy):
        skills = SkillSet((Die(), Zigzag()), policies, call_steps=4, greedy=greedy)
        collector = collector_of(skills)
        for request in itertools.islice(requests(20), first, first + 3):
            collector.collect(request)
        return [e.unwrapped.log for e in collector.engine.envs]

    sampled = play(0, greedy=False)
    assert sampled == play(0, greedy=False)
    assert sampled != play(1, greedy=False)
    assert sampled != play(0, greedy=True)
    if kind == "scripted":
        draws = [a for log in sampled for _, _, a in log]
        assert min(np.bincount(draws, minlength=3)) > len(draws) / 6, "the die is loaded"


def test_skills_go_on_sampling_anew_from_call_to_call():
    collector = collector_of(skill_set(Die, call_steps=3, greedy=False), 1)
    for request in itertools.islice(requests(30), 4):
        collector.collect(request)
    acted = [a for _, _, a in collector.engine.envs[0].unwrapped.log]
    assert len({tuple(acted[i : i + 3]) for i in range(0, 90, 3)}) > 10
