"""Environments follow from their seed; one that does not is noticed before it trains."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from small_runs import ON

import skillweave as sw
from skillweave.envs.make import make_engine


class Noise(gym.Env):
    """Draws its start and the noise of its steps from its spaces, which its class shares."""

    observation_space = Dict(x=Box(-1, 1, (2,), np.float32))
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        noise = self.action_space.sample()
        return {"x": np.append(noise, action)}, float(noise[0]), False, False, {}


class Own(Noise):
    """Draws from a generator that no seed reaches."""

    rng = np.random.default_rng()

    def step(self, action):
        obs, *more = super().step(action)
        return obs | {"x": self.rng.random(2, np.float32)}, *more


def test_draws_from_spaces_are_repeated_from_a_checkpoint():
    one, other = (make_engine(sw.EnvSpec(Noise), 2) for _ in range(2))
    started = one.reset(5).copy()
    assert (started == other.reset(5)).all()
    assert started["x"][0].tolist() != started["x"][1].tolist()
    action = np.zeros((2, 1), np.float32)
    one.step(action)
    one.reset_some(np.array([0]))
    seen = one.step(action).next_obs
    assert (other.restore(one.state())[0] == seen).all()
    one.action_space.seed(0)  # as random_actions() does
    assert (one.step(action).next_obs == other.step(action).next_obs).all()


@pytest.mark.parametrize(
    ("env", "more", "notices"),
    [(Noise, {}, 0), (Own, {}, 1), (Own, {"workers": 2}, 1), (Own, {"check_seed": False}, 0)],
)
def test_what_a_seed_does_not_repeat_is_said_once(tmp_path, recwarn, env, more, notices):
    spec = sw.EnvSpec(env, **{"workers": 1} | more)
    sw.train_agent(spec, ON, 64, tmp_path / "run", seed=0, quiet=True)
    assert sum("check_seed=False" in str(each.message) for each in recwarn) == notices


def test_a_physics_engine_that_does_not_repeat_the_last_digits_is_not_blamed():
    pytest.importorskip("mujoco")
    engine = make_engine(sw.EnvSpec("Ant-v5", engine="sync"), 1)
    engine.trains = True
    engine.reset(0)
