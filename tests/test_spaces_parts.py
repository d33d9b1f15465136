"""Observations of parts and of pixels: packed as one array, split into a vector and images."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from gymnasium.vector.utils import batch_space, iterate
from hypothesis import given, strategies as st

from skillweave.spaces import (
    obs_codec,
    obs_dtype,
    obs_shape,
    pack,
    to_tensor,
    unpack,
)

BYTES = np.uint8


def pixels(*shape, dtype=BYTES, high=255):
    return Box(0, high, shape, dtype)


# Images


@pytest.mark.parametrize(
    ("space", "image"),
    [
        (pixels(7, 8, 7), (7, 8, 7)),  # a tie: first
        (pixels(4, 3, 84, 84), (12, 84, 84)),  # a stack of frames
        (pixels(16, 20), (1, 16, 20)),
        (pixels(5, 6, 3, dtype=bool, high=1), (3, 5, 6)),
        (pixels(84, 84, 4), (4, 84, 84)),
        (pixels(4, 84, 84), (4, 84, 84)),
        (pixels(3, 63, 48), (3, 63, 48)),
        (pixels(10, 11, 4), (4, 10, 11)),  # few channels
        (pixels(42, 48, 12), (12, 42, 48)),
        (pixels(4, 32, 32, 3), (12, 32, 32)),
        (pixels(4, 4, 6), (6, 4, 4)),
        (pixels(6, 4, 4), (6, 4, 4)),
        (pixels(8, 8, 111), (111, 8, 8)),
        (pixels(119, 8, 8), (119, 8, 8)),
        (pixels(19, 19, 17), (17, 19, 19)),
        (pixels(2, 2, 5), (5, 2, 2)),
    ],
    ids=str,
)
def test_images_are_found_with_their_channels(space, image):
    codec = obs_codec(space)
    assert (codec.images, codec.size) == ((image,), 0)
    assert codec.item == space.shape
    assert bool(codec.unclear) == (space.shape == (7, 8, 7))


@pytest.mark.parametrize(
    "shape",
    [
        (3, 3, 3), (7, 7, 7), (3, 4, 5), (5, 4, 3), (8, 10, 27), (27, 10, 8), (9, 10, 14),
        (4, 8, 16), (8, 7, 8), (84, 84, 3, 4),
    ],
    ids=str,
)  # fmt: skip
def test_a_shape_that_does_not_say_where_the_channels_are_is_unclear_until_it_is_said(shape):
    (named,) = obs_codec(pixels(*shape)).unclear
    assert named.startswith(f"the observation of shape {shape}")
    *stack, a, b, c = shape
    frames = stack[0] if stack else 1
    for planes, wanted in (("first", (frames * a, b, c)), ("last", (frames * c, a, b))):
        codec = obs_codec(pixels(*shape), planes)
        assert (codec.images, codec.unclear) == ((wanted,), ())


@pytest.mark.parametrize(
    "space",
    [
        pixels(15, 20),
        pixels(16, 20, dtype=np.int16),
        pixels(400),
        pixels(2, 2, 2, 2, 2),
        Box(-np.inf, 1, (5, 6, 3)),
        Box(0, 1, (16, 20)),
    ],
    ids=str,
)
def test_any_other_box_is_a_vector(space):
    codec = obs_codec(space)
    assert (codec.images, codec.size) == ((), int(np.prod(space.shape)))


def test_the_frames_of_a_stack_follow_each_other():
    last = np.arange(4 * 8 * 9 * 2, dtype=BYTES).reshape(1, 4, 8, 9, 2)
    first = last.transpose(0, 1, 4, 2, 3)
    wanted = first.reshape(1, 8, 8, 9)
    for x in (last, np.ascontiguousarray(first)):
        _, (image,) = obs_codec(pixels(*x.shape[1:])).split(to_tensor(x))
        assert np.array_equal(image.numpy(), wanted)


@pytest.mark.parametrize(
    ("space", "value", "wanted"),
    [
        (pixels(2, 3, 3), 51, 0.2),
        (pixels(2, 3, 3, dtype=bool, high=1), True, 1.0),
        (pixels(2, 3, 3, dtype=np.int32, high=8), 2, 0.25),
        (pixels(2, 3, 3, dtype=np.uint16, high=1000), 500, 0.5),
        (pixels(2, 3, 3, dtype=np.float64, high=1), 0.3, 0.3),
    ],
    ids=str,
)
def test_a_network_sees_pixels_from_zero_to_one(space, value, wanted):
    codec = obs_codec(space)
    x = np.full((1, *space.shape), value, space.dtype)
    _, (image,) = codec.split(to_tensor(x))
    assert image.dtype == to_tensor(x).dtype
    seen = codec.pixels(image, 0)
    assert seen.dtype == torch.float32
    torch.testing.assert_close(seen, torch.full((1, 2, 3, 3), wanted))


# Dict and Tuple

NESTED = Dict(
    [
        ("speed", Box(-1, 1, (2,), np.float64)),
        ("alarm", MultiBinary(2)),
        ("eye", pixels(3, 4, 2)),
        ("rest", Tuple((Discrete(3, start=1), Dict({"gear": MultiDiscrete([2, 2])})))),
    ]
)
BATCH = {
    "speed": np.array([[0.5, -0.5], [1, 0]]),
    "alarm": np.array([[1, 0], [0, 1]], np.int8),
    "eye": np.arange(48, dtype=BYTES).reshape(2, 3, 4, 2),
    "rest": (np.array([1, 3]), {"gear": np.array([[0, 1], [1, 1]])}),
}


def test_parts_are_a_structured_array_that_is_used_as_any_other():
    obs = pack(NESTED, BATCH)
    assert (obs.shape, obs.dtype) == ((2,), obs_dtype(NESTED))
    assert obs.dtype["speed"].base == np.float64
    assert obs.dtype["alarm"].base == np.int8
    assert obs.dtype["rest"]["0"] == np.int64
    assert obs_shape(NESTED) == ()
    assert obs["speed"].tolist() == [[0.5, -0.5], [1, 0]]
    assert obs["rest"]["0"].tolist() == [1, 3]
    assert obs["rest"]["1"]["gear"].tolist() == [[0, 1], [1, 1]]
    other = np.empty_like(obs)
    other[np.array([1, 0])] = obs
    assert np.array_equal(other[np.array([True, False])], obs[1:])
    obs.copy()["speed"][:] = 9
    assert obs["speed"].max() == 1
    assert np.array_equal(pack(NESTED, dict(reversed(BATCH.items()))), obs), "in any order"


def test_what_is_packed_is_not_copied_and_neither_is_one_vector_of_floats():
    obs = pack(NESTED, BATCH)
    assert pack(NESTED, obs) is obs
    plain = np.zeros((3, 2), np.float32)
    assert pack(Box(-1, 1, (2,)), plain) is plain
    assert unpack(Box(-1, 1, (2,)), plain) is plain
    vector, _ = obs_codec(Box(-1, 1, (2,))).split(to_tensor(plain))
    plain[1, 1] = 5
    assert vector[1].tolist() == [0, 5]


def test_a_nested_observation_is_split_by_hand():
    codec = obs_codec(NESTED)
    assert (codec.size, codec.images, codec.scaled) == (2 + 2 + 3 + 4, ((2, 3, 4),), True)
    vector, (eye,) = codec.split(to_tensor(pack(NESTED, BATCH)))
    assert vector.dtype == torch.float32
    assert vector.tolist() == [
        [0.5, -0.5, 1, 0, 1, 0, 0, 1, 0, 0, 1],
        [1, 0, 0, 1, 0, 0, 1, 0, 1, 0, 1],
    ]
    assert np.array_equal(eye.numpy(), BATCH["eye"].transpose(0, 3, 1, 2))


def test_a_tensor_of_a_structured_array_shares_its_memory():
    obs = pack(NESTED, BATCH)
    raw, split = to_tensor(obs), obs_codec(NESTED).split
    assert (raw.dtype, raw.shape) == (torch.uint8, (2, obs.dtype.itemsize))
    obs["speed"][0, 0] = 0.75
    assert split(raw)[0][0, 0] == 0.75
    backwards = split(to_tensor(obs[::-1]))  # not contiguous: a copy
    assert torch.equal(backwards[0], split(raw)[0].flip(0))


NUMBERS = [np.float16, np.float32, np.float64, np.uint8, np.int16, np.int64, np.uint16, np.bool_]


def boxes():
    shapes = st.lists(st.integers(1, 4), max_size=4).map(tuple)
    return st.builds(lambda shape, dtype: Box(0, 1, shape, dtype), shapes, st.sampled_from(NUMBERS))


leaves = st.one_of(
    boxes(),
    st.builds(lambda n, start: Discrete(n, start=start), st.integers(1, 4), st.integers(-2, 2)),
    st.builds(MultiDiscrete, st.lists(st.integers(1, 3), min_size=1, max_size=3)),
    st.builds(MultiBinary, st.integers(1, 3)),
)
spaces = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.dictionaries(st.sampled_from("zyxabc"), inner, min_size=1, max_size=3).map(
            lambda found: Dict(list(found.items()))
        ),
        st.lists(inner, min_size=1, max_size=3).map(Tuple),
    ),
    max_leaves=5,
)


@given(spaces, st.integers(1, 3), st.integers(0, 99))
def test_packing_loses_nothing(space, n, seed):
    space.seed(seed)
    batched = batch_space(space, n)
    batched.seed(seed)
    sample = batched.sample()
    obs = pack(space, sample)
    assert (obs.shape, obs.dtype) == ((n, *obs_shape(space)), obs_dtype(space))
    back = unpack(space, obs)
    assert batched.contains(back)
    assert np.array_equal(pack(space, back), obs)
    for row, one in zip(iterate(batched, sample), obs, strict=True):
        assert np.array_equal(pack(space, row), one)


@given(spaces, st.integers(0, 99))
def test_the_vector_is_that_of_the_parts_side_by_side(space, seed):
    space.seed(seed)
    obs = pack(space, space.sample())
    vector, images = obs_codec(space).split(to_tensor(obs))
    vectors, pictures = [], []

    def walk(part, value):
        if isinstance(part, Dict):
            for name, inner in part.spaces.items():
                walk(inner, value[name])
        elif isinstance(part, Tuple):
            for i, inner in enumerate(part.spaces):
                walk(inner, value[str(i)])
        else:
            some, found = obs_codec(part).split(to_tensor(np.asarray(value)))
            vectors.append(some)
            pictures.extend(found)

    walk(space, obs)
    assert torch.equal(vector, torch.cat(vectors))
    assert len(images) == len(pictures)
    assert all(torch.equal(a, b) for a, b in zip(images, pictures, strict=True))
