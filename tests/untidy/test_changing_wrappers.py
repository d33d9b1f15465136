"""Wrappers that change while they are used, and environments that do not start again."""

import gymnasium as gym
import numpy as np
import pytest
from timed import SMALL, Timed

import skillweave as sw
from skillweave.errors import EnvError


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


def test_statistics_that_no_longer_change_are_fine():
    def frozen(env):
        env = gym.wrappers.NormalizeObservation(env)
        env.obs_rms.mean, env.obs_rms.var = np.full(4, 0.1), np.full(4, 0.5)
        env.update_running_mean = False
        return env

    spec = sw.EnvSpec("CartPole-v1", wrappers=(frozen,))
    run = sw.train_agent(spec, SMALL, 256, quiet=True)
    assert run.evaluate(8, num_envs=1).returns == run.evaluate(8, num_envs=8).returns


class Scaled(gym.ObservationWrapper):
    """A user's own statistics: the largest number so far."""

    def __init__(self, env):
        super().__init__(env)
        self.most = 1e-6

    def observation(self, obs):
        self.most = max(self.most, float(np.abs(obs).max()))
        return (obs / self.most).astype(np.float32)


class Harder(Timed):
    """Starts further away with each episode."""

    episode = 0

    def show(self):
        self.episode += self.t == 0
        return np.array([self.t or self.episode], np.float32)


class Unseeded(Timed):
    """Draws what it shows from a generator of its own that no seed reaches."""

    def show(self):
        return np.random.default_rng().normal(size=1).astype(np.float32)


@pytest.mark.parametrize(
    "env",
    [sw.EnvSpec("CartPole-v1", wrappers=(Scaled,)), Harder, Unseeded],
    ids=["own statistics", "curriculum", "unseeded"],
)
def test_a_score_that_depends_on_num_envs_is_said(env):
    policy = sw.from_function(lambda obs: np.zeros(len(obs), int))
    with pytest.warns(UserWarning, match="starts another episode.*num_envs=episodes"):
        sw.evaluate(policy, env, episodes=6, num_envs=2)
