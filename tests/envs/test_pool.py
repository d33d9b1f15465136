"""A user's own pools: EnvPool's environments seen otherwise, for training."""

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
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


class Doubled(sw.PoolWrapper):
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


def test_a_pool_of_another_environment_is_told():
    class Wide(Clock):
        observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)

    with pytest.raises(EnvError, match=r"OneClock: its pool's observation_space is Box.*3"):
        make_engine(sw.EnvSpec(OneClock, pool=Wide), 2)


def test_what_envpool_shows_may_be_changed():
    pytest.importorskip("envpool")

    class First(sw.PoolWrapper):
        def __init__(self, pool):
            super().__init__(pool, gym.spaces.Box(-np.inf, np.inf, (1,), np.float32))

        def see(self, obs, ids):
            return obs[:, :1]

    def pool(num_envs, threads, seed):
        return First(sw.envpool("CartPole-v1", num_envs, threads, seed))

    def one(render_mode=None):
        env = gym.make("CartPole-v1")
        space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        return gym.wrappers.TransformObservation(env, lambda obs: obs[:1], space)

    seen = make_engine(sw.EnvSpec(one, pool=pool), N).reset(0)
    whole = make_engine(sw.EnvSpec("CartPole-v1"), N).reset(0)
    np.testing.assert_array_equal(seen, whole[:, :1])


def test_an_environment_that_envpool_does_not_have_is_told():
    pytest.importorskip("envpool")
    says = r"EnvPool has no environment 'CartPool-v1'.* Close matches: .*CartPole-v1"
    with pytest.raises(EnvError, match=says):
        sw.envpool("CartPool-v1", 2, 1, 0)
