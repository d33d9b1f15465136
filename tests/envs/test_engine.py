"""Every engine has one meaning: it steps those named, and resets only when told."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from toys import Ledger, Rememberer, actions, cartpole

from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import EnvError, MissingExtra

# EnvPool's own, for some environments; that users do not see it is tested once, below.
pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")
ENGINES = ["envpool", "sync"]


@pytest.fixture
def engine(request):
    """Makes engines, and closes them in the end."""
    made = []

    def make(name: str, env="CartPole-v1", num_envs: int = 3, **kwargs):
        if name == "envpool":
            pytest.importorskip("envpool")
        made.append(make_engine(EnvSpec(env, engine=name, **kwargs), num_envs, threads=1))
        return made[-1]

    yield make
    for e in made:
        e.close()


@pytest.mark.parametrize("name", ENGINES)
def test_a_seed_reproduces_resets_and_what_follows_and_another_does_not(engine, name):
    e = engine(name)

    def play(seed: int) -> np.ndarray:
        seen = [e.reset(seed)]
        for t in range(5):
            seen.append(e.step(actions(3, t)).next_obs)
        seen.append(e.reset_some(np.array([1])))
        return np.concatenate(seen).copy()

    first = play(7)
    assert np.array_equal(play(7), first)
    assert not np.array_equal(play(8), first)
    assert len(np.unique(first[:3], axis=0)) == 3, "environments start alike"


@pytest.mark.parametrize("name", ENGINES)
def test_shapes_and_types_are_those_promised(engine, name):
    e = engine(name)
    obs = e.reset(0)
    raw = e.step(np.zeros(3, np.int64))
    assert (e.num_envs, e.action_space) == (3, gym.spaces.Discrete(2))
    for x in (obs, raw.next_obs):
        assert (x.shape, x.dtype) == ((3, 4), np.float32)
    assert (raw.reward.shape, raw.reward.dtype) == ((3,), np.float32)
    for x in (raw.terminated, raw.truncated):
        assert (x.shape, x.dtype) == ((3,), np.bool_)


@pytest.mark.parametrize("name", ENGINES)
def test_partial_steps_leave_the_others_untouched_and_answer_in_the_order_asked(engine, name):
    e = engine(name)
    now = e.reset(0).copy()
    for ids in ([2, 0], [1], [2], [0, 1, 2], [1, 0], [2, 1]):
        action = np.array([i % 2 for i in ids])
        raw = e.step(action, np.array(ids))
        assert len(raw.next_obs) == len(raw.reward) == len(raw.terminated) == len(ids)
        for i, a, obs in zip(ids, action, raw.next_obs, strict=True):
            # had an environment moved while it was not asked, this would not be its successor
            np.testing.assert_allclose(obs, cartpole(now[i], a), atol=1e-5)
            now[i] = obs


@pytest.mark.parametrize("name", ENGINES)
def test_resetting_some_in_mid_episode_leaves_the_others_where_they_were(engine, name):
    e = engine(name)
    e.reset(0)
    for _ in range(4):
        before = e.step(np.ones(3, np.int64)).next_obs.copy()
    first = e.reset_some(np.array([2, 0])).copy()
    assert (np.abs(first) <= 0.05).all(), "not at the start of an episode"
    assert not np.array_equal(first[0], first[1])
    after = e.step(np.ones(3, np.int64)).next_obs
    for now, then in zip(after, [first[1], before[1], first[0]], strict=True):
        np.testing.assert_allclose(now, cartpole(then, 1), atol=1e-5)


@pytest.mark.parametrize("name", ENGINES)
def test_an_ended_episode_waits_for_its_reset_and_goes_on_with_a_real_step(engine, name):
    e = engine(name, num_envs=2)
    now, ends = e.reset(0).copy(), 0
    for _ in range(40):  # always pushing right ends an episode after about ten steps
        raw = e.step(np.ones(2, np.int64))
        for obs, before in zip(raw.next_obs, now, strict=True):
            np.testing.assert_allclose(obs, cartpole(before, 1), atol=1e-5)
        assert (raw.reward == 1.0).all()
        now = raw.next_obs.copy()
        ids = np.flatnonzero(raw.terminated)
        ends += len(ids)
        if len(ids):
            assert (np.abs(now[ids, 2]) > 0.2).all(), "not the observation that ended the episode"
            now[ids] = e.reset_some(ids)
            assert (np.abs(now[ids]) <= 0.05).all()
    assert ends >= 6


def test_some_can_be_reset_to_seeds_of_their_own_but_not_in_envpool(engine):
    e = engine("sync")
    e.reset(0)
    obs = e.reset_some(np.array([2, 0]), seeds=[11, 12])
    for row, seed in zip(obs, [11, 12], strict=True):
        assert np.array_equal(row, gym.make("CartPole-v1").reset(seed=seed)[0])
    e = engine("envpool")
    e.reset(0)
    with pytest.raises(EnvError, match="EnvPool cannot reset single environments"):
        e.reset_some(np.array([0]), seeds=[1])


def test_infos_of_a_partial_step_stand_in_the_order_asked(engine):
    e = engine("sync", Ledger)
    e.reset(0)
    e.step(np.zeros(1, np.int64), np.array([2]))
    info = e.step(np.zeros(2, np.int64), np.array([2, 0])).info
    assert info["t"].tolist() == info["nested"]["t"].tolist() == [2, 1]


def test_an_environment_may_keep_the_action_it_was_given(engine):
    e = engine("sync", Rememberer, num_envs=2)
    e.reset(0)
    action, changes = np.zeros((2, 1), np.float32), []
    for a in (0.5, -0.5, -0.5):
        action[:] = a  # the caller may use its array again
        changes.append(e.step(action).reward.tolist())
    assert changes == [[0.5, 0.5], [1.0, 1.0], [0.0, 0.0]]


def test_an_episode_that_is_over_must_be_reset_and_the_others_go_on(engine):
    e = engine("sync", Ledger, num_envs=2)  # both episodes have two steps
    e.reset(0)
    both, second = np.zeros(2, np.int64), np.array([1])
    e.step(both)
    assert e.step(both[:1], second).terminated.all()
    e.step(both[:1], np.array([0]))
    with pytest.raises(AssertionError, match="must be reset first"):
        e.step(both[:1], second)
    e.reset_some(second)
    e.step(both[:1], second)


@pytest.mark.parametrize("name", ENGINES)
def test_continuous_actions_reach_the_environment(engine, name):
    e = engine(name, "Pendulum-v1", num_envs=2)
    obs = e.reset(0).copy()
    torque = np.float32([[2.0], [-1.0]])
    after = e.step(torque).next_obs
    for before, u, now in zip(obs, torque, after, strict=True):
        env = gym.make("Pendulum-v1").unwrapped
        env.reset()
        env.state = np.array([np.arctan2(before[1], before[0]), before[2]])
        np.testing.assert_allclose(now, env.step(u)[0], atol=1e-4)


@pytest.mark.parametrize("name", ENGINES)
def test_a_time_limit_truncates_and_does_not_terminate(engine, name):
    e = engine(name, "Pendulum-v1", num_envs=2)
    e.reset(0)
    for t in range(1, 201):
        raw = e.step(np.zeros((2, 1), np.float32))
        assert not raw.terminated.any()
        assert raw.truncated.all() == raw.truncated.any() == (t == 200)


def fall(obs: np.ndarray, lefts: int) -> list[int]:
    """The actions that push left some times, then right until the pole has fallen."""
    taken: list[int] = []
    while abs(obs[2]) < np.deg2rad(12):
        taken.append(int(len(taken) >= lefts))
        obs = cartpole(obs, taken[-1])
    return taken


@pytest.mark.parametrize("name", ENGINES)
def test_an_episode_that_terminates_on_its_time_limit_is_not_truncated_too(engine, name):
    e = engine(name, num_envs=1)
    obs, plan = e.reset(0)[0], []
    for t in range(1, 501):
        if t > 470 and not plan:  # fall on step 500 exactly, if that is possible from here
            plan = next((p for n in range(4) if len(p := fall(obs, n)) == 501 - t), [])
        action = plan.pop(0) if plan else int(obs @ [0.1, 0.3, 3.0, 1.0] > 0)
        raw = e.step(np.array([action]))
        obs = raw.next_obs[0]
        assert (raw.terminated[0] or raw.truncated[0]) == (t == 500)
    # EnvPool cannot tell: it computes `terminated = done & ~truncated` itself.
    assert (raw.terminated[0], raw.truncated[0]) == (name != "envpool", name == "envpool")


def test_wrappers_and_settings_reach_every_environment(engine):
    wrapper = [
        lambda env: gym.wrappers.TimeLimit(env, 3),
        lambda env: gym.wrappers.RescaleObservation(env, 0, 1),
    ]
    e = engine("sync", "MountainCar-v0", kwargs={"goal_velocity": 1.0}, wrappers=tuple(wrapper))
    assert ((e.reset(0) >= 0) & (e.reset(0) <= 1)).all()
    assert [e.step(np.ones(3, np.int64)).truncated.any() for _ in range(3)] == [False, False, True]


def test_auto_takes_envpool_where_the_environment_is_gymnasiums_own(engine):
    pytest.importorskip("envpool")
    assert type(engine("auto")).__name__ == "EnvPoolEngine"
    assert type(engine("auto", Ledger)).__name__ == "GymnasiumEngine"
    assert type(engine("auto", kwargs={"sutton_barto_reward": True})).__name__ == "GymnasiumEngine"


@pytest.mark.parametrize("name", ENGINES)
def test_making_an_engine_is_silent(engine, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        engine(name).reset(0)


def test_a_missing_dependency_names_the_extra(monkeypatch):
    def absent(*_, **__):
        raise gym.error.DependencyNotInstalled("Box2D is not installed")

    monkeypatch.setattr(gym, "make", absent)
    with pytest.raises(MissingExtra, match=r"LunarLander-v3 needs the extra 'box2d': pip install"):
        EnvSpec("LunarLander-v3").make()


def test_a_spec_knows_whether_it_is_only_data():
    assert EnvSpec("CartPole-v1", kwargs={"sutton_barto_reward": True}).is_data
    assert not EnvSpec("module:CartPole-v1").is_data
    assert not EnvSpec(Ledger).is_data
    assert not EnvSpec("CartPole-v1", wrappers=(gym.Wrapper,)).is_data
    assert (EnvSpec(Ledger).name, EnvSpec("CartPole-v1").name) == ("Ledger", "CartPole-v1")
