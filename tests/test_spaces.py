import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple
from hypothesis import given, strategies as st

from skillweave.errors import EnvError, RunError
from skillweave.spaces import (
    action_codec,
    obs_codec,
    obs_dtype,
    obs_shape,
    pack,
    same_space,
    space_from_json,
    space_to_json,
    to_tensor,
)


def encode(space: gym.Space, obs) -> list[float]:
    codec = obs_codec(space)
    encoded, images = codec.split(torch.as_tensor(np.asarray(obs)))
    assert images == codec.images == ()
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


SPACES = [
    Box(-1, 1, (2, 3)),
    Discrete(4, start=2),
    MultiDiscrete([2, 3]),
    MultiBinary(3),
    Box(0, 255, (5, 6, 3), np.uint8),
    Dict({"a": Discrete(3), "b": Tuple((Box(-1, 1, (2,)), Box(0, 255, (2, 4, 5), np.uint8)))}),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
@pytest.mark.parametrize("lead", [(), (5,), (2, 3), (2, 3, 4), (0,)], ids=str)
def test_any_leading_axes_are_kept_and_rows_stay_in_their_place(space, lead):
    space.seed(0)
    rows = np.empty((int(np.prod(lead)), *obs_shape(space)), obs_dtype(space))
    for row in range(len(rows)):
        rows[row] = pack(space, space.sample())
    codec = obs_codec(space)
    whole = to_tensor(rows.reshape((*lead, *obs_shape(space))))
    assert whole.shape == (*lead, *codec.item)
    vector, images = codec.split(whole)
    assert vector.shape == (*lead, codec.size)
    assert [i.shape for i in images] == [(*lead, *shape) for shape in codec.images]
    for one, row in enumerate(rows):
        alone, pictures = codec.split(to_tensor(np.asarray(row)))
        assert torch.equal(vector.reshape(len(rows), codec.size)[one], alone)
        for image, picture in zip(images, pictures, strict=True):
            assert torch.equal(image.reshape(-1, *picture.shape)[one], picture)


def test_only_real_numbers_are_to_be_normalised():
    assert obs_codec(Box(-1, 1, (2,))).scaled
    assert not obs_codec(Discrete(3)).scaled
    assert not obs_codec(MultiBinary(3)).scaled
    assert not obs_codec(Box(0, 255, (8, 8, 3), np.uint8)).scaled
    assert obs_codec(Dict({"a": Discrete(3), "b": Box(-1, 1, (2,))})).scaled


PARTS = Dict({"a": Discrete(3, start=-1), "b": Box(-1, 1, (2,)), "c": MultiDiscrete([2, 4])})


@pytest.mark.parametrize(
    ("part", "value", "wrong"),
    [
        ("a", 1, None),
        ("a", 2, "a choice that does not exist"),
        ("a", -2, "a choice that does not exist"),
        ("b", [5, -7], None),  # numbers outside a Box's bounds are common
        ("b", [0, np.inf], "not finite"),
        ("b", [np.nan, 0], "not finite"),
        ("c", [1, 3], None),
        ("c", [2, 0], "a choice that does not exist"),
    ],
)
def test_raw_observations_are_checked_part_by_part(part, value, wrong):
    given = {"a": [0, 1], "b": np.zeros((2, 2), np.float32), "c": np.zeros((2, 2), np.int64)}
    given[part][1] = value
    raw = to_tensor(pack(PARTS, {k: np.asarray(v) for k, v in given.items()}))
    if wrong is None:
        obs_codec(PARTS).check(raw)
        return
    with pytest.raises(ValueError, match=wrong):
        obs_codec(PARTS).check(raw)


def test_between_the_parts_of_an_observation_is_nothing():
    space = Dict({"a": Box(-1, 1, (2,), np.float64), "b": MultiBinary(3)})
    batched = {"a": np.ones((4, 2)), "b": np.ones((4, 3), np.int8)}
    assert obs_dtype(space).itemsize > 2 * 8 + 3
    found = set()
    for i in range(20):
        np.full(4 * obs_dtype(space).itemsize, i, np.uint8)  # what memory held before
        found.add(pack(space, batched).tobytes())
    assert len(found) == 1


@pytest.mark.parametrize("space", [Text(3), Dict({"a": Tuple((Text(3),))})], ids=str)
def test_an_unsupported_observation_space_says_which_are_supported(space):
    with pytest.raises(EnvError, match=r"observation .* Box, Discrete, MultiDiscrete, MultiB"):
        obs_codec(space)


@pytest.mark.parametrize("space", [Box(0, 999, (1,), np.int64), Dict({"a": Text(2)})], ids=str)
def test_an_unsupported_action_space_says_which_are_supported(space):
    wanted = "supported are: Discrete, MultiDiscrete, MultiBinary, Box, and Dict and Tuple of these"
    with pytest.raises(EnvError, match=wanted):
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


def test_each_dimension_is_scaled_where_it_has_two_bounds_and_clipped_where_it_has_one():
    codec = action_codec(Box(np.float32([0, -np.inf, -1]), np.float32([4, np.inf, np.inf])))
    units = np.float32([[0, 7.5, 9], [-1, -7.5, -9], [0.5, 0, 0]])
    assert codec.to_env(units).tolist() == [[2, 7.5, 9], [0, -7.5, -1], [3, 0, 0]]
    assert codec.from_env(codec.to_env(units)).tolist() == [
        [0, 7.5, 9],
        [-1, -7.5, -1],
        [0.5, 0, 0],
    ]
    assert units.tolist()[0] == [0, 7.5, 9], "the policy's own array was written to"


def test_bounds_as_wide_as_their_type_scale_nothing():
    limit = float(np.finfo(np.float32).max)
    codec = action_codec(Box(-limit, limit, (1,)))
    assert codec.to_env(np.float32([[2.5]])).tolist() == [[2.5]]


def test_a_dimension_of_one_value_is_that_value():
    codec = action_codec(Box(np.float32([3]), np.float32([3])))
    assert codec.to_env(np.float32([[0.7]])).tolist() == [[3]]
    assert np.isfinite(codec.from_env(np.float32([[3]]))).all()


def test_several_choices_count_from_their_starts_in_the_shape_of_the_space():
    codec = action_codec(MultiDiscrete([[2, 3], [4, 5]], start=[[0, -1], [2, 0]], dtype=np.int32))
    assert (codec.parts, codec.size, codec.discrete, codec.multi) == ((2, 3, 4, 5), 14, True, True)
    env = codec.to_env(np.array([[1, 2, 3, 4]]))
    assert (env.tolist(), env.dtype) == ([[[1, 1], [5, 4]]], np.int32)


def test_binary_actions_are_bytes_in_the_shape_of_the_space():
    codec = action_codec(MultiBinary([2, 2]))
    assert (codec.parts, codec.size, codec.discrete, codec.multi) == ((2,) * 4, 8, True, True)
    env = codec.to_env(np.array([[1, 0, 0, 1]]))
    assert (env.tolist(), env.dtype) == ([[[1, 0], [0, 1]]], np.int8)


def test_the_parts_of_a_single_choice_and_of_none():
    one, none = action_codec(Discrete(3)), action_codec(Box(-1, 1, (2, 3)))
    assert (one.parts, one.size, one.discrete, one.multi) == ((3,), 3, True, False)
    assert (none.parts, none.size, none.discrete, none.multi) == ((), 6, False, False)


def test_actions_take_the_shape_and_type_of_the_space():
    env = action_codec(Box(-1, 1, (2, 3), np.float64)).to_env(np.zeros((4, 6), np.float32))
    assert (env.shape, env.dtype) == ((4, 2, 3), np.float64)


numbers = st.floats(-1e3, 1e3, width=32)


def assert_within(space: Box, actions: list[float]) -> None:
    for action in action_codec(space).to_env(np.float32(actions)[:, None]):
        assert space.contains(action), f"{action} not in {space}"


bounds = st.one_of(numbers, st.just(np.inf))


@st.composite
def action_spaces(draw):
    """Any action space of a few parts."""
    parts = st.lists(st.integers(1, 4), min_size=1, max_size=4)
    kind = draw(st.sampled_from(["discrete", "multi", "binary", "box"]))
    if kind == "discrete":
        return Discrete(draw(st.integers(1, 5)), start=draw(st.integers(-3, 3)))
    if kind == "multi":
        nvec = draw(parts)
        start = draw(st.lists(st.integers(-3, 3), min_size=len(nvec), max_size=len(nvec)))
        return MultiDiscrete(nvec, start=start)
    if kind == "binary":
        return MultiBinary(draw(st.sampled_from([1, 3, [2, 2]])))
    ends = draw(st.lists(st.tuples(bounds, bounds), min_size=1, max_size=4))
    low = [-a if np.isinf(a) else min(a, b) for a, b in ends]
    high = [np.inf if np.isinf(b) else b if np.isinf(a) else max(a, b) for a, b in ends]
    return Box(np.float32(low), np.float32(high))


@given(action_spaces(), st.integers(0, 999))
def test_an_action_of_the_space_survives_policy_units_and_back(space, seed):
    space.seed(seed)
    codec, actions = action_codec(space), np.stack([space.sample() for _ in range(3)])
    units = codec.from_env(actions)
    assert units.shape == ((3,) if isinstance(space, Discrete) else (3, units.shape[1]))
    back = codec.to_env(units)
    assert (back.dtype, back.shape) == (np.dtype(space.dtype), actions.shape)
    assert all(space.contains(row if row.shape else row[()]) for row in back)
    if codec.discrete:
        assert np.array_equal(back, actions)
        parts = np.array(codec.parts)
        assert ((units.reshape(3, -1) >= 0) & (units.reshape(3, -1) < parts)).all()
    else:
        width = np.where(
            np.isfinite(space.high - space.low), space.high - space.low, np.abs(actions)
        )
        assert (np.abs(back - actions) <= 1e-4 + 1e-5 * (width + np.abs(actions))).all()


@given(action_spaces(), st.integers(0, 999))
def test_whatever_a_policy_chooses_is_in_the_space(space, seed):
    rng, codec = np.random.default_rng(seed), action_codec(space)
    if codec.discrete:
        units = np.stack([rng.integers(n, size=5) for n in codec.parts], axis=1)
        units = units if codec.multi else units[:, 0]
    else:
        units = rng.normal(scale=3, size=(5, codec.size)).astype(np.float32)
    assert all(space.contains(row if row.shape else row[()]) for row in codec.to_env(units))


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
        MultiDiscrete([2, 3], dtype=np.int8),
        Dict([("z", Discrete(2)), ("a", Tuple((Box(-1, 1, (2,)), MultiBinary(2))))]),
    ],
    ids=str,
)
def test_a_space_survives_json(space):
    back = space_from_json(json.loads(json.dumps(space_to_json(space))))
    assert same_space(space, back)
    assert back == space


def number(value):
    return {"array": value, "dtype": "int64"}


def discrete(**changes):
    """A changed entry of Discrete(3)."""
    bounds = {"low": number(0), "high": number(2)}
    return {"type": "Space", "kind": "Discrete", "dtype": "int64"} | bounds | changes


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"type": "Text"},
        {"type": "Space", "kind": "Text"},
        {"type": "Space", "kind": "Discrete"},
        discrete(low=number(0), high=number(-1)),
        discrete(shape=[2], low=number(0), high=number([1, 2])),
        discrete(dtype="wide"),
        discrete(low=number(0) | {"dtype": "uint8"}, high=number(300) | {"dtype": "uint8"}),
        discrete(owners={"a": [0, 1]}),
        {"type": "Space", "kind": "MultiBinary"} | {k: number(1) for k in ("low", "high")},
        {"type": "Space", "kind": "Box", "dtype": "float32", "shape": [10**12]},
        {"type": "Space", "kind": "Dict", "parts": {"a": 1}},
        {"type": "Space", "kind": "Dict", "parts": [["a", {"type": "Text"}]]},
    ],
    ids=str,
)
def test_json_that_is_no_space_is_an_error_for_people(data):
    with pytest.raises(RunError, match="space"):
        space_from_json(data)


def test_spaces_are_the_same_if_a_policy_of_one_can_act_in_the_other():
    assert same_space(Box(-1, 1, (2,)), Box(-9, 9, (2,)))
    assert not same_space(Box(-1, 1, (2,)), Box(-1, 1, (3,)))
    assert same_space(Discrete(3), Discrete(3))
    assert not same_space(Discrete(3), Discrete(4))
    assert not same_space(Discrete(3), MultiBinary(3))
    assert not same_space(MultiDiscrete([2, 3]), MultiDiscrete([3, 2]))
    assert not same_space(Discrete(3), Discrete(3, start=1))  # another action altogether


def test_spaces_of_parts_are_the_same_if_their_parts_are_in_the_same_order():
    def space(*names, choices=2, numbers=np.float32):
        return Dict(
            [(name, Tuple((Discrete(choices), Box(-1, 1, (2,), numbers)))) for name in names]
        )

    assert same_space(space("a", "b"), space("a", "b"))
    assert not same_space(space("a", "b"), space("b", "a"))
    assert not same_space(space("a"), space("b"))
    assert not same_space(space("a"), space("a", "b"))
    assert not same_space(space("a"), space("a", choices=3))
    assert not same_space(space("a"), space("a", numbers=np.float64))  # other bytes
    assert not same_space(space("a"), Tuple((Discrete(2),)))


def test_spaces_of_pixels_are_the_same_if_pixels_mean_the_same():
    pixels = Box(0, 255, (8, 8, 3), np.uint8)
    assert same_space(pixels, Box(0, 255, (8, 8, 3), np.uint8))
    assert not same_space(pixels, Box(0, 1, (8, 8, 3), np.float32))
    assert not same_space(pixels, Box(-np.inf, np.inf, (8, 8, 3)))  # a vector


def test_a_space_that_holds_no_number_is_refused():
    with pytest.raises(EnvError, match=r"the observation space Box.* holds no number"):
        obs_codec(gym.spaces.Box(0.0, 1.0, (0,), np.float32))
