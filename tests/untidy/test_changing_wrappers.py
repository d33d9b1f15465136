"""Wrappers that change while they are used, and environments that do not start again."""

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.errors import EnvError

SMALL = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((8,)))


class Own(gym.wrappers.NormalizeObservation):
    """A user's subclass."""


@pytest.mark.parametrize(
    ("wrapper", "instead"),
    [
        (gym.wrappers.NormalizeObservation, "normalize_obs=True"),
        (gym.wrappers.NormalizeReward, "normalize_returns=True"),
        (lambda env: gym.wrappers.ClipReward(Own(env), -1, 1), "the wrapper Own changes"),
    ],
)
def test_they_are_refused_before_anything_is_trained(wrapper, instead, tmp_path):
    spec = sw.EnvSpec("CartPole-v1", wrappers=(wrapper,))
    with pytest.raises(EnvError, match=instead):
        sw.train_agent(spec, SMALL, 256, tmp_path / "run", quiet=True)
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def test_statistics_that_no_longer_change_are_fine(tmp_path):
    def frozen(env):
        env = gym.wrappers.NormalizeObservation(env)
        env.obs_rms.mean, env.obs_rms.var = np.full(4, 0.1), np.full(4, 0.5)
        env.update_running_mean = False
        return env

    spec = sw.EnvSpec("CartPole-v1", wrappers=(frozen,))
    run = sw.train_agent(spec, SMALL, 256, tmp_path / "run", quiet=True)
    assert run.evaluate(8, num_envs=1).returns == run.evaluate(8, num_envs=8).returns


class Scaled(gym.ObservationWrapper):
    """A user's own statistics: the largest number so far."""

    def __init__(self, env):
        super().__init__(env)
        self.most = 1e-6

    def observation(self, obs):
        self.most = max(self.most, float(np.abs(obs).max()))
        return (obs / self.most).astype(np.float32)


class Harder(gym.Env):
    """Starts further away with each episode."""

    observation_space = gym.spaces.Box(-100, 100, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    episode = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return np.array([self.episode], np.float32), {}

    def step(self, action):
        self.t += 1
        return np.array([self.t], np.float32), 1.0, False, self.t == 5, {}


class Unseeded(Harder):
    """Draws its start from a generator of its own that no seed reaches."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.random.default_rng().normal(size=1).astype(np.float32), {}


@pytest.mark.parametrize(
    "env",
    [sw.EnvSpec("CartPole-v1", wrappers=(Scaled,)), Harder, Unseeded],
    ids=["own statistics", "curriculum", "unseeded"],
)
def test_a_score_that_depends_on_num_envs_is_said(env):
    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    with pytest.warns(UserWarning, match="starts another episode.*num_envs=episodes"):
        sw.evaluate(policy, env, episodes=6, num_envs=2)
