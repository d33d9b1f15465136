"""A user's own pools: EnvPool's environments seen otherwise, for training."""

import os
import subprocess
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import skillweave as sw
from skillweave.envs import PoolWrapper, one_of
from skillweave.envs.make import make_engine, workers_for
from skillweave.errors import EnvError, MissingExtra

N = 5


class Clock:
    """Without EnvPool: environments that count to ten; the reward is the pool's seed."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, num_envs=1, threads=1, seed=0):
        self.time, self.seed = np.zeros(num_envs, np.float32), seed

    def reset(self, ids):
        self.time[ids] = 0
        return self.time[ids, None], {}

    def step(self, action, ids):
        self.time[ids] += 1 + action
        over = self.time[ids] >= 10
        reward = np.full(len(ids), self.seed, np.float32)
        return self.time[ids, None], reward, over, np.zeros(len(ids), bool), {}


class OneClock(gym.Env):
    observation_space, action_space = Clock.observation_space, Clock.action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1 + action
        return np.array([self.time], np.float32), 0.0, self.time >= 10, False, {}


class Doubled(PoolWrapper):
    def see(self, obs, ids):
        return 2 * obs + ids[:, None].astype(np.float32)


def doubled(num_envs, threads, seed):
    return Doubled(Clock(num_envs, threads, seed))


def test_an_engine_steps_a_users_pool_and_each_environment_knows_its_number():
    engine = make_engine(sw.EnvSpec(OneClock, pool=doubled), N)
    obs = engine.reset(7)
    np.testing.assert_array_equal(obs[:, 0], np.arange(N))
    raw = engine.step(np.array([0, 1, 0, 1, 0]))
    np.testing.assert_array_equal(raw.next_obs[:, 0], np.add(np.arange(N), [2, 4, 2, 4, 2]))
    np.testing.assert_array_equal(raw.reward, np.full(N, 7.0))
    np.testing.assert_array_equal(engine.reset_some(np.array([3]))[:, 0], [3.0])
    np.testing.assert_array_equal(engine.step(np.zeros(N, int)).next_obs[3], [5.0])


def test_episodes_of_a_users_pool_are_played_again():
    spec = sw.EnvSpec(OneClock, pool=doubled)
    first, rng = make_engine(spec, N), np.random.default_rng(0)
    first.reset(3)
    for _ in range(17):
        raw = first.step(rng.integers(2, size=N))
        if (ended := np.flatnonzero(raw.terminated)).size:
            first.reset_some(ended)
    again = make_engine(spec, N)
    obs, early = again.restore(first.state())
    action = rng.integers(2, size=N)
    np.testing.assert_array_equal(again.step(action).next_obs, first.step(action).next_obs)
    assert not early.size
    assert obs.shape == (N, 1)


@pytest.mark.slow
def test_agents_learn_in_a_users_pool_and_are_scored_in_the_environment_itself(tmp_path):
    agent = sw.PPO(num_envs=4, n_steps=8, batch_size=32)
    run = sw.train_agent(
        sw.EnvSpec(OneClock, pool=doubled), agent, 64, tmp_path / "run", quiet=True
    )
    assert run.evaluate(3).mean == 0.0  # there every reward is 0
    seed = run.info()["stages"][0]["final"]["return"]
    assert seed != 0.0


@pytest.mark.parametrize("engine", ["auto", "sync"])
def test_only_one_process_steps_a_pool(engine):
    spec = sw.EnvSpec(OneClock, pool=doubled, engine=engine)
    name = type(make_engine(spec, 2)).__name__
    assert (name == "EnvPoolEngine") == (engine == "auto")
    assert workers_for(spec) == 1


def test_where_a_pool_cannot_be_made_the_environment_itself_is_stepped():
    def missing(num_envs, threads, seed):
        raise MissingExtra("the clock", "envpool")

    assert type(make_engine(sw.EnvSpec(OneClock, pool=missing), 2)).__name__ == "GymnasiumEngine"
    with pytest.raises(EnvError, match=r"EnvPool cannot run OneClock"):
        make_engine(sw.EnvSpec(OneClock, pool=missing, engine="envpool"), 2)


def test_what_envpool_shows_may_be_changed():
    pytest.importorskip("envpool")

    class First(PoolWrapper):
        def __init__(self, pool):
            super().__init__(pool, gym.spaces.Box(-np.inf, np.inf, (1,), np.float32))

        def see(self, obs, ids):
            return obs[:, :1]

    def pool(num_envs, threads, seed):
        return First(sw.envs.envpool("CartPole-v1", num_envs, threads, seed))

    def one(render_mode=None):
        env = gym.make("CartPole-v1")
        space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        return gym.wrappers.TransformObservation(env, lambda obs: obs[:1], space)

    seen = make_engine(sw.EnvSpec(one, pool=pool), N).reset(0)
    whole = make_engine(sw.EnvSpec("CartPole-v1"), N).reset(0)
    np.testing.assert_array_equal(seen, whole[:, :1])


def test_an_environment_that_envpool_does_not_have_is_told():
    pytest.importorskip("envpool")
    says = r"EnvPool has no environment 'CartPool-v1': is 'CartPole-v[01]' meant"
    with pytest.raises(EnvError, match=says):
        sw.envs.envpool("CartPool-v1", 2, 1, 0)


class Parts(Clock):
    """Observations of two parts, and what only a pool has: pictures, and an info with rows."""

    observation_space = gym.spaces.Dict(
        time=gym.spaces.Box(0, 1000, (1,), np.float32), root=gym.spaces.Discrete(1000)
    )

    def seen(self, obs):
        return {"root": np.full(len(obs), self.seed), "time": obs}

    def reset(self, ids):
        obs, _ = super().reset(ids)
        return self.seen(obs), {"ids": ids, "inner": {"twice": 2 * obs}}

    def step(self, action, ids):
        obs, *rest = super().step(action, ids)
        return self.seen(obs), *rest[:-1], {"ids": ids, "inner": {"twice": 2 * obs}}

    def render(self, ids):
        return np.full((len(ids), 4, 5, 3), self.time[ids][:, None, None, None], np.uint8)


class Later(PoolWrapper):
    def see(self, obs, ids):
        return obs | {"time": obs["time"] + 100}


def later(num_envs, threads, seed):
    return Later(Parts(num_envs, threads, seed % 1000))


def test_observations_of_parts_come_out_of_a_pool_as_out_of_single_environments():
    spec = sw.EnvSpec(one_of(later), pool=later)
    pool, single = make_engine(spec, N), make_engine(replace(spec, engine="sync"), N)
    assert (type(pool).__name__, type(single).__name__) == ("EnvPoolEngine", "GymnasiumEngine")
    obs, other = pool.reset(7), single.reset(7)
    assert obs.dtype == other.dtype
    rng, early = np.random.default_rng(0), np.array([4, 1])
    for t in range(3):
        np.testing.assert_array_equal(obs["time"], other["time"])
        np.testing.assert_array_equal(obs["root"], np.full(N, 7))
        action = rng.integers(2, size=N)
        step, want = pool.step(action), single.step(action)
        obs, other = step.next_obs, want.next_obs
        np.testing.assert_array_equal(step.reward, np.full(N, 7.0))
        assert obs["time"].min() > 100 + t
    again, ended = make_engine(spec, N).restore(pool.state())
    np.testing.assert_array_equal(again, obs)
    assert not ended.size
    assert pool.reset_some(early)["time"].tolist() == [[100.0], [100.0]]


def test_one_environment_of_a_pool_is_one_of_gymnasium():
    env = one_of(later)("rgb_array")
    check_env(env, skip_render_check=True)
    obs, info = env.reset(seed=5)
    assert (obs["root"], obs["time"]) == (5, [100.0])
    assert info == {"ids": 0, "inner": {"twice": [0.0]}}
    obs, reward, terminated, truncated, info = env.step(1)
    assert (obs["time"], reward, terminated, truncated) == ([102.0], 5.0, False, False)
    assert info["inner"]["twice"] == [4.0]
    np.testing.assert_array_equal(env.render(), np.full((4, 5, 3), 2))
    for _ in range(4):
        terminated = env.step(1)[2]
    assert terminated
    assert env.reset()[0]["root"] == 5  # the same pool goes on
    assert one_of(later)().render() is None
    starts = {int(one_of(later)().reset()[0]["root"]) for _ in range(8)}
    assert len(starts) > 1  # without a seed it starts anywhere
    assert sw.EnvSpec(one_of(later), pool=later).name == "later"
    assert sw.EnvSpec(one_of(Clock), pool=Clock).name == "Clock"
    clock = one_of(Clock)("rgb_array")
    with pytest.raises(gym.error.ResetNeeded):
        clock.step(1)
    clock.reset()
    with pytest.raises(EnvError, match=r"cannot be rendered: give it a method render\(ids\)"):
        clock.render()


def test_a_pool_of_another_environment_is_told():
    class Wide(Clock):
        observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)

    def other(num_envs, threads, seed):
        space = gym.spaces.Dict(time=gym.spaces.Box(0, 1000, (2,)), root=gym.spaces.Discrete(1000))
        return PoolWrapper(Parts(num_envs, threads, seed), space)

    with pytest.raises(EnvError, match=r"OneClock: its pool's observation_space is Box.*3"):
        make_engine(sw.EnvSpec(OneClock, pool=Wide), 2)
    with pytest.raises(EnvError, match=r"later: its pool's observation_space is Dict"):
        make_engine(sw.EnvSpec(one_of(later), pool=other), 2)


def test_parts_of_a_pool_may_come_in_another_order():
    def other(num_envs, threads, seed):
        space = Parts.observation_space
        turned = gym.spaces.Dict([(k, space[k]) for k in reversed(list(space))])
        return PoolWrapper(Parts(num_envs, threads, seed), turned)

    engine = make_engine(sw.EnvSpec(one_of(later), pool=other), 2)
    assert type(engine).__name__ == "EnvPoolEngine"
    obs = engine.reset(9)
    assert (obs["root"].tolist(), obs["time"].tolist()) == ([9, 9], [[0.0], [0.0]])


def test_one_environment_of_envpool_plays_the_episodes_of_its_seed():
    pytest.importorskip("envpool")

    def poles(num_envs, threads, seed):
        return sw.envs.envpool("CartPole-v1", num_envs, threads, seed, max_episode_steps=12)

    env = one_of(poles)()
    spec = sw.EnvSpec(one_of(poles), pool=poles)
    agent = sw.from_function(lambda obs: (obs[:, 2] + 0.5 * obs[:, 3] > 0).astype(int))
    for engine in ("sync", "envpool"):
        assert sw.evaluate(agent, spec, episodes=3, engine=engine).lengths == (12, 12, 12)
    first = env.reset(seed=3)[0]
    np.testing.assert_array_equal(env.reset(seed=3)[0], first)
    assert np.abs(env.reset(seed=4)[0] - first).max() > 0


def test_importing_envpool_leaves_the_environment_and_matplotlib_as_they_were():
    pytest.importorskip("envpool")
    pytest.importorskip("matplotlib")
    code = """
import os, gymnasium, matplotlib
before, backend = dict(os.environ), dict.__getitem__(matplotlib.rcParams, "backend")
for name in [n for n in __import__("sys").modules if n.startswith("matplotlib")]:
    del __import__("sys").modules[name]
from skillweave.envs.pool import installed
assert installed().list_all_envs()
import matplotlib
assert dict(os.environ) == before, os.environ.keys() ^ before.keys()
assert type(dict.__getitem__(matplotlib.rcParams, "backend")) is type(backend)
"""
    env = {k: v for k, v in os.environ.items() if k not in ("MPLBACKEND", "MPLCONFIGDIR")}
    subprocess.run([sys.executable, "-c", code], check=True, env=env)
