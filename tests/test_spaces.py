import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text
from hypothesis import given
from hypothesis import strategies as st

from skillweave.spaces import (
    action_codec,
    obs_codec,
    same_space,
    space_from_json,
    space_to_json,
)
from skillweave.types import SkillweaveError


def encode(space: gym.Space, obs) -> list[float]:
    codec = obs_codec(space)
    encoded = codec.encode(torch.as_tensor(np.asarray(obs)))
    assert encoded.dtype == torch.float32
    assert encoded.shape[-1] == codec.size
    return encoded.tolist()


def test_a_discrete_observation_is_one_hot_from_its_start():
    assert encode(Discrete(3, start=5), [5, 7]) == [[1, 0, 0], [0, 0, 1]]


def test_multidiscrete_observations_are_one_hots_side_by_side():
    assert encode(MultiDiscrete([2, 3], start=[0, 1]), [[1, 1]]) == [[0, 1, 1, 0, 0]]


def test_multidiscrete_observations_of_two_axes_are_flattened():
    assert encode(MultiDiscrete([[2, 2], [2, 2]]), [[[0, 1], [1, 0]]]) == [[1, 0, 0, 1, 0, 1, 1, 0]]


def test_binary_observations_are_zeros_and_ones():
    assert encode(MultiBinary(3), np.array([[1, 0, 1]], np.int8)) == [[1, 0, 1]]


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8, np.int64])
def test_a_box_is_flattened_to_floats_of_the_same_value(dtype):
    assert encode(Box(0, 9, (2, 2), dtype), np.array([[[1, 2], [3, 4]]], dtype)) == [[1, 2, 3, 4]]


SPACES = [Box(-1, 1, (2, 3)), Discrete(4, start=2), MultiDiscrete([2, 3]), MultiBinary(3)]


@pytest.mark.parametrize("space", SPACES, ids=str)
@pytest.mark.parametrize("lead", [(), (5,), (2, 3), (2, 3, 4)], ids=str)
def test_any_leading_axes_are_kept_and_rows_stay_in_their_place(space, lead):
    space.seed(0)
    count = int(np.prod(lead))
    rows = np.stack([np.asarray(space.sample()) for _ in range(count)])
    codec = obs_codec(space)
    whole = codec.encode(torch.from_numpy(rows.reshape((*lead, *space.shape))))
    each = torch.stack([codec.encode(torch.from_numpy(r[None]))[0] for r in rows])
    assert torch.equal(whole, each.reshape(*lead, codec.size))


def test_only_real_numbers_are_to_be_normalised():
    assert obs_codec(Box(-1, 1, (2,))).scaled
    assert not obs_codec(Discrete(3)).scaled


@pytest.mark.parametrize("space", [Dict({"a": Discrete(2)}), Text(3)], ids=str)
def test_an_unsupported_observation_space_says_which_are_supported(space):
    with pytest.raises(
        SkillweaveError, match=r"observation .* Box, Discrete, MultiDiscrete, MultiB"
    ):
        obs_codec(space)


@pytest.mark.parametrize(
    "space", [MultiDiscrete([2, 2]), MultiBinary(2), Box(0, 9, (1,), np.int64)], ids=str
)
def test_an_unsupported_action_space_says_which_are_supported(space):
    with pytest.raises(SkillweaveError, match=r"action space .* supported are: Discrete, Box"):
        action_codec(space)


def test_discrete_actions_count_from_the_spaces_start():
    assert action_codec(Discrete(3)).to_env(np.array([0, 2])).tolist() == [0, 2]
    codec = action_codec(Discrete(3, start=-1))
    assert (codec.size, codec.to_env(np.array([0, 2])).tolist()) == (3, [-1, 1])


def test_minus_one_to_one_spans_a_bounded_box():
    codec = action_codec(Box(np.float32([0, -2]), np.float32([1, 6])))
    units = np.float32([[-1, -1], [0, 0], [1, 1], [-9, 9]])
    assert codec.to_env(units).tolist() == [[0, -2], [0.5, 2], [1, 6], [0, 6]]


def test_an_unbounded_box_takes_actions_as_they_are():
    codec = action_codec(Box(-np.inf, np.inf, (1,)))
    assert codec.to_env(np.float32([[-7.5], [8]])).tolist() == [[-7.5], [8]]


def test_actions_take_the_shape_and_type_of_the_space():
    env = action_codec(Box(-1, 1, (2, 3), np.float64)).to_env(np.zeros((4, 6), np.float32))
    assert (env.shape, env.dtype) == ((4, 2, 3), np.float64)


numbers = st.floats(-1e3, 1e3, width=32)


def assert_within(space: Box, actions: list[float]) -> None:
    for action in action_codec(space).to_env(np.float32(actions)[:, None]):
        assert space.contains(action), f"{action} not in {space}"


@given(numbers, numbers, st.lists(numbers, min_size=1, max_size=4))
def test_every_action_lies_within_a_bounded_space(a, b, actions):
    low, high = sorted((a, b))
    assert_within(Box(low, high, (1,), np.float32), [*actions, -1.0, 1.0])


@given(numbers, st.lists(numbers, min_size=1, max_size=4), st.booleans())
def test_every_action_lies_within_a_space_bounded_on_one_side(bound, actions, below):
    low, high = (bound, np.inf) if below else (-np.inf, bound)
    assert_within(Box(low, high, (1,), np.float32), actions)


@pytest.mark.parametrize(
    "space",
    [
        Box(np.float32([-np.inf, 0.1]), np.float32([np.inf, 1 / 3])),
        Box(0, 255, (2, 2, 3), np.uint8),
        Discrete(4, start=-2),
        MultiDiscrete([[2, 3], [4, 5]], start=[[0, 1], [2, 3]]),
        MultiBinary(3),
        MultiBinary([2, 3]),
    ],
    ids=str,
)
def test_a_space_survives_json(space):
    back = space_from_json(json.loads(json.dumps(space_to_json(space))))
    assert same_space(space, back)
    assert back == space


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"type": "Text"},
        {"type": "Discrete"},
        {"type": "Discrete", "n": 0, "start": 0},
        {"type": "Discrete", "n": "three", "start": 0},
        {"type": "Box", "shape": [2], "dtype": "float32", "low": [0], "high": [1, 2, 3]},
        {"type": "Box", "shape": [1], "dtype": "wide", "low": [0], "high": [1]},
        {"type": "MultiDiscrete", "nvec": [0], "start": [0]},
    ],
    ids=str,
)
def test_json_that_is_no_space_is_an_error_for_people(data):
    with pytest.raises(SkillweaveError, match="space"):
        space_from_json(data)


def test_spaces_are_the_same_if_a_policy_of_one_can_act_in_the_other():
    assert same_space(Box(-1, 1, (2,)), Box(-9, 9, (2,)))
    assert not same_space(Box(-1, 1, (2,)), Box(-1, 1, (3,)))
    assert same_space(Discrete(3), Discrete(3))
    assert not same_space(Discrete(3), Discrete(4))
    assert not same_space(Discrete(3), MultiBinary(3))
    assert not same_space(MultiDiscrete([2, 3]), MultiDiscrete([3, 2]))
    assert not same_space(Discrete(3), Discrete(3, start=1))  # another action altogether
