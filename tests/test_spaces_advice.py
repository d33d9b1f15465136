"""Spaces and simulators that are not supported: the error shows a way, and the way works."""

import dataclasses
import re

import gymnasium
import gymnasium as gym
import numpy
import numpy as np
import pytest
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    Graph,
    MultiBinary,
    MultiDiscrete,
    OneOf,
    Sequence,
    Text,
    Tuple,
)
from gymnasium.vector import AutoresetMode, VectorEnv
from toys import REALS, World

import skillweave as sw

SMALL = sw.PPO(num_envs=2, n_steps=8)


def refused(tmp_path, env):
    """Return the message of the error that training raises before it makes a run."""
    with pytest.raises(sw.SkillweaveError) as error:
        sw.train_agent(env, SMALL, 16, tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()
    return str(error.value)


def followed(tmp_path, env, message, function=None):
    """Train by the wrapper that a message shows; return the run."""
    assert "\n" not in message
    code = message[message.index("EnvSpec(") :].replace("Box(...)", "Box(0, 1, (2,), 'float32')")
    names = {
        "EnvSpec": sw.EnvSpec, "env": env, "gymnasium": gymnasium, "numpy": numpy,
        "function": function,
    }  # fmt: skip
    spec = dataclasses.replace(eval(code, names), workers=1)
    return sw.train_agent(spec, SMALL, 48, tmp_path / "run", quiet=True)


SUPPORTED = {
    "two": Box(0, 3, (2,), np.int64),
    "bytes": Box(0, 255, (2,), np.uint8),
    "no axis": Box(-3, 3, (), np.int32),
    "matrix": Box(0, 3, (2, 2), np.int8),
    "different": Box(np.array([0, -2]), np.array([5, 9]), dtype=np.int64),
    "flags": Box(0, 1, (2,), bool),
    "choices": Dict(a=Discrete(3), b=Discrete(2, start=4)),
    "numbers": Dict(x=REALS, y=Box(0, 1, (), np.float32)),
    "tuple of one": Tuple((Discrete(3),)),
    "nested": Tuple((REALS, Dict(g=MultiBinary(3), h=MultiDiscrete([2, 3], start=[1, 1])))),
    "matrices": Tuple((MultiBinary((2, 2)), MultiDiscrete([[2, 3], [4, 5]]))),
    "whole and real": Dict(a=Box(0, 3, (2,), np.int64), b=REALS),
    "without bounds": Dict(a=Box(-np.inf, np.inf, (2,), np.float32), d=Discrete(2)),
}


@pytest.mark.parametrize("space", SUPPORTED.values(), ids=SUPPORTED)
def test_actions_of_several_parts_and_whole_numbers_need_no_wrapper(tmp_path, space):
    run = sw.train_agent(
        sw.EnvSpec(lambda: World(action_space=space), workers=1), SMALL, 48, tmp_path, quiet=True
    )
    assert run.evaluate(2, quiet=True).mean == 5


MANY = r"at most 256 values each.*TransformAction\(env, function, gymnasium\.spaces\.Box\("
ASKED = r"TransformAction\(env, function, gymnasium\.spaces\.Box\("
REFUSED = {
    "many": (Box(0, 256, (2,), np.int64), MANY),
    "picture": (Box(0, 255, (8, 8, 3), np.uint8), MANY),
    "no bounds": (Box(-(2**63), 2**63 - 1, (1,), np.int64), MANY),
    "many in a dict": (Dict(a=Box(0, 10**6, (2,), np.int64), b=REALS), "part a of .*" + MANY),
    "text": (Text(3), ASKED),
    "sequence": (Sequence(REALS), ASKED),
    "dict": (Dict(t=Text(3), b=REALS), ASKED),
    "text in a part": (
        Dict(a=Dict(b=Tuple((Discrete(2), Text(3))))),
        r"part a\.b\.1 of .*, Text.* is not supp",
    ),
    "nothing": (Dict(a=Discrete(2), b=Box(-1, 1, (0,))), "part b of .* nothing .*: leave it out"),
    "wide": (Dict(a=Box(-1, 1, (1,), np.longdouble)), "part a of the action space, .* float128"),
    "all wide": (Box(-1, 1, (1,), np.longdouble), "action space Box.* take float64 there"),
}


@pytest.mark.parametrize(("space", "says"), REFUSED.values(), ids=REFUSED)
def test_actions_that_are_not_supported_are_named_and_a_function_is_asked_for(
    tmp_path, space, says
):
    message = refused(tmp_path, lambda: World(action_space=space))
    assert re.search(says, message)
    assert ("at most 256 values each" in message) == says.endswith(MANY)


def test_each_value_of_a_whole_number_can_be_chosen(tmp_path):
    taken = set()

    class Notes(World):
        def step(self, action):
            taken.add(tuple(action.tolist()))
            return super().step(action)

    def env():
        return Notes(action_space=Box(np.array([0, -1]), np.array([1, 1]), dtype=np.int64))

    sw.train_agent(sw.EnvSpec(env, workers=1), SMALL, 48, tmp_path / "run", quiet=True)
    assert taken == {(a, b) for a in (0, 1) for b in (-1, 0, 1)}


SHOWN = {
    "text": (Text(5), "FlattenObservation"),
    "one of": (OneOf([REALS, Discrete(3)]), "FlattenObservation"),
    "sequence": (Sequence(REALS), "TransformObservation"),
    "graph": (Graph(REALS, Discrete(2)), "TransformObservation"),
    "text in a dict": (Dict(a=REALS, b=Text(3)), r"FilterObservation\(env, \['a'\]\)"),
    "sequence below": (
        Dict(a=Dict(x=REALS, y=Sequence(REALS)), c=Discrete(2)),
        r"the part a\.y.*FilterObservation\(env, \['c'\]\)",
    ),
    "text alone in a dict": (Dict(b=Text(3)), "FlattenObservation"),
    "text in a tuple": (Tuple((REALS, Text(3))), "the part 1.*FlattenObservation"),
    "sequence in a tuple": (Tuple((REALS, Sequence(REALS))), "TransformObservation"),
}


@pytest.mark.parametrize(("space", "way"), SHOWN.values(), ids=SHOWN)
def test_a_wrapper_for_observations_is_shown_and_works(tmp_path, space, way):
    def env():
        return World(observation_space=space)

    message = refused(tmp_path, env)
    assert re.search(way, message), message
    run = followed(tmp_path, env, message, lambda obs: np.zeros(2, np.float32))
    assert run.evaluate(2, quiet=True).mean == 5


class Mission(gym.Space):
    """A space of the user's own, as MiniGrid's missions are."""

    def __init__(self):
        super().__init__(dtype=str)

    def sample(self, mask=None, probability=None):
        return "go to the door"

    def contains(self, x):
        return isinstance(x, str)


def test_a_space_of_the_users_own_is_left_out(tmp_path):
    space = Dict(direction=Discrete(4), image=Box(0, 255, (7, 7, 3), np.uint8), mission=Mission())

    def env():
        return World(observation_space=space)

    message = refused(tmp_path, env)
    assert "the part mission of the observation space" in message
    assert followed(tmp_path, env, message).evaluate(2, quiet=True).mean == 5


def test_minigrid_trains_as_proposed(tmp_path):
    pytest.importorskip("minigrid")
    name = "MiniGrid-Empty-5x5-v0"
    followed(tmp_path, name, refused(tmp_path, name))


# Simulators that step many environments at once


class Batched(VectorEnv):
    """Steps all its environments, and resets those that end in the same step."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs=4):
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = REALS, Discrete(2)
        self.observation_space = gym.vector.utils.batch_space(REALS, num_envs)
        self.action_space = gym.vector.utils.batch_space(Discrete(2), num_envs)

    def reset(self, *, seed=None, options=None):
        self.t = np.zeros(self.num_envs, int)
        return self.see(), {}

    def see(self):
        return np.stack([self.t, self.t], 1).astype(np.float32)

    def step(self, action):
        self.t += 1
        over, last = self.t == 5, self.see()
        self.t[over] = 0
        reward = np.ones(self.num_envs)
        return self.see(), reward, np.zeros(self.num_envs, bool), over, {"final_obs": last}


def batched():
    return Batched()


gym.register("BatchedForTests-v0", entry_point=None, vector_entry_point=Batched)
GIVEN = {
    "class": Batched,
    "instance": Batched(),
    "function": batched,
    "lambda": lambda: Batched(2),
    "gymnasium's": lambda: gym.make_vec("CartPole-v1", num_envs=2),
    "id": "BatchedForTests-v0",
}


@pytest.mark.parametrize("env", GIVEN.values(), ids=GIVEN)
def test_a_batched_simulator_is_refused_with_a_way(tmp_path, env):
    message = refused(tmp_path, env)
    assert "steps many environments at once" in message
    assert "write a gymnasium.Env around a simulator of one environment (num_envs=1)" in message
    with pytest.raises(sw.SkillweaveError, match="many environments at once"):
        sw.EnvSpec(env).make()


def test_a_pool_that_steps_all_at_once_is_refused(tmp_path):
    def pool(num_envs, threads, seed):
        return Batched(num_envs)

    message = refused(tmp_path, sw.EnvSpec(World, pool=pool))
    assert "must step some while the others do not change" in message
    sw.train_agent(sw.EnvSpec(World), SMALL, 16, tmp_path / "run", quiet=True)  # without pool
