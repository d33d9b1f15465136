"""Environments that reset themselves and put an episode's last observation into info."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

import skillweave as sw
from skillweave.envs.checked import LAST_OBSERVATIONS
from skillweave.envs.env_infos import batched_infos, info_numbers, reported_success
from skillweave.envs.make import make_engine
from skillweave.planning import Mission
from skillweave.planning.mission import as_task
from skillweave.planning.task_env import Tasked

FORMS = {"one": np.copy, "batch": lambda obs: obs[None], "list": lambda obs: [obs]}


class Auto(gym.Env):
    """Counts to three, and then shows zero."""

    observation_space, action_space = Box(-9, 9, (2,), np.float32), Discrete(2)

    def __init__(self, key="final_obs", form=FORMS["one"]):
        self.key, self.form = key, form

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.t += 1
        obs = np.full(2, self.t, np.float32)
        if self.t < 3:
            return obs, 0.0, False, False, {}
        return self.reset()[0], 0.0, True, False, {self.key: self.form(obs), f"_{self.key}": True}


class Doubled(gym.ObservationWrapper):
    def observation(self, obs):
        return 2 * obs


def last_of(spec):
    engine = make_engine(spec, 2)
    engine.reset(0)
    for _ in range(3):
        raw = engine.step(np.zeros(2, np.int64))
    return raw


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("key", LAST_OBSERVATIONS)
def test_the_last_observation_is_the_true_successor(key, form):
    spec = sw.EnvSpec(Auto, kwargs={"key": key, "form": FORMS[form]})
    assert last_of(spec).next_obs.tolist() == [[3, 3]] * 2


def test_wrappers_and_tasks_have_it():
    assert last_of(sw.EnvSpec(Auto, wrappers=(Doubled,))).next_obs.tolist() == [[6, 6]] * 2
    task = as_task(Mission(lambda step: step.next_obs[:, 0] > 2))
    raw = last_of(sw.EnvSpec(Auto, wrappers=(Tasked(task),)))
    assert reported_success(raw.info, 2).tolist() == [1, 1]


def test_one_of_another_shape_is_not_used_and_that_is_said():
    with pytest.warns(UserWarning, match="final_obs"):
        assert not last_of(sw.EnvSpec(Auto, kwargs={"form": len})).next_obs.any()
    assert not last_of(sw.EnvSpec(Auto, kwargs={"form": lambda _: None})).next_obs.any()


def test_is_success_counts_where_success_is_missing():
    both = {"success": False, "is_success": True}
    unknown = {"success": None}
    infos = [{"is_success": 1.0}, both, {}, unknown, unknown | {"is_success": 1}]
    np.testing.assert_array_equal(reported_success(batched_infos(infos), 5), [1, 0, 0, np.nan, 1])
    info = batched_infos([{"is_success": True}])
    assert info_numbers(info, "success", np.arange(1), 1).tolist() == [1]
    assert reported_success(info | {"env_reward": np.zeros(1)}, 1) is None  # not the task's
