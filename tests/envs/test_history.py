"""Environments that are brought back: by their seeds, and by what was done since."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skillweave.envs.skill_env import SkillEnv

from skillweave.envs import envpool_engine
from skillweave.envs.history import History
from skillweave.envs.joined import JoinedEnvs
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.seeding import Seeds
from skillweave.skills import Skill

N = 5
pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")


@given(st.lists(st.tuples(st.sampled_from("asbf"), st.integers(0, 2**N - 1)), max_size=200))
@settings(deadline=None, max_examples=60)
def test_a_history_plays_again_what_was_done(plan):
    history = History(N, np.zeros(N, np.int64))
    done: list[list] = [[] for _ in range(N)]
    for number, (kind, bits) in enumerate(plan):
        ids = np.flatnonzero([bits >> i & 1 for i in range(N)])
        if kind in "as" and len(ids):
            history.add(np.full(len(ids), number), ids)
            for i in ids:
                done[i].append(number)
        elif kind == "b":
            history.begin(ids)
            for i in ids:
                if not done[i] or done[i][-1] != "begins":
                    done[i].append("begins")
        elif kind == "f" and len(ids):
            history.forget(ids)
            for i in ids:
                done[i].clear()
    again = History(N, np.zeros(N, np.int64))
    again.load(history.state())
    played: list[list] = [[] for _ in range(N)]
    for begins, ids, actions in again.play():
        for i in begins:
            played[i].append("begins")
        for i, action in zip(ids, actions, strict=True):
            played[i].append(int(action))
    assert played == done


def run(engine, steps: int, seed: int, renew: int = 0) -> list:
    """Everything that an engine shows while it is acted in at random."""
    rng, shown = np.random.default_rng(seed), []
    engine.action_space.seed(seed)
    for t in range(steps):
        ids = np.sort(rng.permutation(N)[: rng.integers(1, N + 1)])
        action = np.stack([engine.action_space.sample() for _ in ids])
        raw = engine.step(action, ids)
        ended = ids[raw.terminated | raw.truncated]
        shown += [raw.next_obs, raw.reward, ended]
        if len(ended):
            shown.append(engine.reset_some(ended))
        if renew and t % renew == renew - 1:
            engine.renew(int(rng.integers(2**31)))
    return shown


@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1", "LunarLander-v3"])
@pytest.mark.parametrize("engine", ["envpool", "sync", "async"])
def test_an_engine_that_is_restored_goes_on_as_if_nothing_had_happened(engine, env, monkeypatch):
    if engine == "envpool":
        pytest.importorskip("envpool")
    if engine == "async" and env != "CartPole-v1":
        pytest.skip("one environment in processes is enough")
    monkeypatch.setattr(envpool_engine, "RENEW_AFTER", 150)
    spec = EnvSpec(env, engine=engine)
    first, second = make_engine(spec, N, threads=1), make_engine(spec, N, threads=1)
    try:
        first.reset(3)
        run(first, 333, 0, renew=50)
        state = first.state()
        made = first.steps_made
        obs, early = second.restore(state)
        assert early.tolist() == []
        assert second.steps_made == 0, "played again, not made"
        again = second.state()
        assert all(np.array_equal(again[k], v) for k, v in state.items())
        for got, want in zip(run(second, 100, 1), run(first, 100, 1), strict=True):
            np.testing.assert_array_equal(got, want)
        assert second.steps_made == first.steps_made - made
        assert obs.shape == (N, *first.observation_space.shape)
    finally:
        first.close()
        second.close()


def test_old_pools_are_left_one_episode_at_a_time_and_histories_stay_short(monkeypatch):
    pytest.importorskip("envpool")
    monkeypatch.setattr(envpool_engine, "RENEW_AFTER", 100)
    engine = make_engine(EnvSpec("CartPole-v1", engine="envpool"), N, threads=1)
    engine.reset(0)
    longest, pools = 0, set()
    for part in range(40):
        run(engine, 20, part)
        engine.renew(part)
        longest, pools = max(longest, engine.state()["length"].sum()), pools | {len(engine._pools)}
    assert pools == {1, 2}
    assert longest < 400, "a hundred steps, and the episodes that were open"


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
    spec = EnvSpec(Hasty, engine="sync")
    first, second = (SkillEnv(make_engine(spec, 3)) for _ in range(2))
    first.reset(Seeds(0))
    for _ in range(5):
        first.step(np.array([0, 1, 0]))
    first.renew(Seeds(1))
    monkeypatch.setattr(Hasty, "hurry", True)
    assert second.restore(first.state()).tolist() == [1]
    monkeypatch.setattr(Hasty, "hurry", False)
    assert second.step(np.zeros(3, np.int64)).terminated.tolist() == [False] * 3
    assert second.renew(Seeds(2)).tolist() == []
    assert second.state()["elapsed"].tolist() == [6, 1, 6]


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


def test_environments_that_do_not_repeat_themselves_begin_anew_and_are_named():
    spec = EnvSpec(Moody, engine="sync")
    first, second = (SkillEnv(make_engine(spec, 3)) for _ in range(2))
    first.reset(Seeds(0))
    first.step(np.array([0, 1, 0]))
    assert first.renew(Seeds(1)).tolist() == []
    assert second.restore(first.state()).tolist() == [1]
    assert second.obs[:, 0].tolist() == [0.5, 0.0, 0.5]


def test_an_episode_that_never_ends_is_ended_where_it_is_too_long_to_be_kept(monkeypatch):
    monkeypatch.setattr("skillweave.envs.skill_env.LONGEST_EPISODE", 10)
    env = SkillEnv(make_engine(EnvSpec(Moody, engine="sync"), 2))
    env.reset(Seeds(0))
    for _ in range(10):
        env.step(np.zeros(2, np.int64))
    assert env.renew(Seeds(1)).tolist() == []
    env.step(np.zeros(2, np.int64))
    assert env.renew(Seeds(2)).tolist() == [0, 1]
    assert env.obs.tolist() == [[0.0], [0.0]]
    assert env.state()["engine.length"].tolist() == [0, 0]


class Second(Skill):
    """May start where the pole leans to the right."""

    max_steps = 7

    def initiation(self, obs):
        return obs[:, 2] > 0.02


def test_a_search_for_a_start_is_counted_and_repeats_itself():
    def fresh() -> SkillEnv:
        return SkillEnv(make_engine(EnvSpec("CartPole-v1", engine="sync"), 3), Second())

    env, again = fresh(), fresh()
    env.reset(Seeds(5))
    searched = env.steps_made
    assert searched > 0
    for t in range(30):
        env.step(np.full(3, t % 2))
    assert env.steps_made > searched + 90, "every start is looked for"
    env.renew(Seeds(6))
    assert again.restore(env.state()).tolist() == []
    for t in range(60):
        one, other = env.step(np.full(3, t % 2)), again.step(np.full(3, t % 2))
        np.testing.assert_array_equal(one.obs, other.obs)


def test_joined_environments_are_those_of_their_parts():
    def fresh() -> JoinedEnvs:
        spec = EnvSpec("CartPole-v1", engine="sync")
        return JoinedEnvs([SkillEnv(make_engine(spec, 2)) for _ in range(3)])

    joined, parts = fresh(), fresh().parts
    obs = joined.reset(Seeds(1))
    assert obs.shape == (6, 4)
    for i, part in enumerate(parts):
        np.testing.assert_array_equal(part.reset(Seeds(1) / i), obs[2 * i : 2 * i + 2])
    action = np.array([0, 1, 1, 0, 1, 1])
    for _ in range(30):
        step = joined.step(action)
        for i, part in enumerate(parts):
            rows = slice(2 * i, 2 * i + 2)
            own = part.step(action[rows])
            np.testing.assert_array_equal(step.obs[rows], own.obs)
            np.testing.assert_array_equal(step.terminated[rows], own.terminated)
    assert joined.steps_made == 180
    joined.renew(Seeds(2))
    again = fresh()
    assert again.restore(joined.state()).tolist() == []
    np.testing.assert_array_equal(again.obs, joined.obs)
    np.testing.assert_array_equal(again.step(action).obs, joined.step(action).obs)


def test_what_begins_anew_at_a_cut_begins_so_after_a_resume_too(monkeypatch):
    monkeypatch.setattr("skillweave.envs.skill_env.LONGEST_EPISODE", 3)
    spec = EnvSpec("CartPole-v1", engine="sync")
    env, again = (SkillEnv(make_engine(spec, 3), Second()) for _ in range(2))
    env.reset(Seeds(5))
    for _ in range(5):
        env.step(np.zeros(3, np.int64))
    assert len(env.renew(Seeds(6)))
    assert again.restore(env.state()).tolist() == []
    for t in range(60):
        one, other = env.step(np.full(3, t % 2)), again.step(np.full(3, t % 2))
        np.testing.assert_array_equal(one.obs, other.obs)
