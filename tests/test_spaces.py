import json

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from hypothesis import given, strategies as st

from skillweave.errors import RunError
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


@pytest.mark.parametrize(
    ("space", "obs", "encoded"),
    [
        (Discrete(3, start=5), [5, 7], [[1, 0, 0], [0, 0, 1]]),
        (MultiDiscrete([2, 3], start=[0, 1]), [[1, 1]], [[0, 1, 1, 0, 0]]),
        (MultiDiscrete([[2, 2], [2, 2]]), [[[0, 1], [1, 0]]], [[1, 0, 0, 1, 0, 1, 1, 0]]),
        (MultiBinary(3), [[1, 0, 1]], [[1, 0, 1]]),
        *(
            (Box(0, 9, (2, 2), dtype), [[[1, 2], [3, 4]]], [[1, 2, 3, 4]])
            for dtype in (np.float32, np.float64, np.uint8, np.int64)
        ),
    ],
    ids=str,
)
def test_observations_are_one_hot_or_floats_of_the_same_value(space, obs, encoded):
    codec = obs_codec(space)
    vector, images = codec.split(torch.as_tensor(np.asarray(obs, space.dtype)))
    assert images == codec.images == ()
    assert codec.scaled == isinstance(space, Box), "only real numbers are to be normalised"
    assert vector.dtype == torch.float32
    assert vector.shape[-1] == codec.size
    assert vector.tolist() == encoded


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


def test_between_the_parts_of_an_observation_is_nothing():
    space = Dict({"a": Box(-1, 1, (2,), np.float64), "b": MultiBinary(3)})
    batched = {"a": np.ones((4, 2)), "b": np.ones((4, 3), np.int8)}
    assert obs_dtype(space).itemsize > 2 * 8 + 3
    found = set()
    for i in range(20):
        np.full(4 * obs_dtype(space).itemsize, i, np.uint8)  # what memory held before
        found.add(pack(space, batched).tobytes())
    assert len(found) == 1


LIMIT = float(np.finfo(np.float32).max)
ACTIONS = [
    (Discrete(3), [0, 2], [0, 2]),
    (Discrete(3, start=-1), [0, 2], [-1, 1]),
    (
        MultiDiscrete([[2, 3], [4, 5]], start=[[0, -1], [2, 0]], dtype=np.int32),
        [[1, 2, 3, 4]],
        [[[1, 1], [5, 4]]],
    ),
    (MultiBinary([2, 2]), [[1, 0, 0, 1]], [[[1, 0], [0, 1]]]),
    (
        Box(np.float32([0, -2]), np.float32([1, 6])),
        [[-1, -1], [0, 0], [1, 1], [-9, 9]],
        [[0, -2], [0.5, 2], [1, 6], [0, 6]],
    ),
    (Box(-np.inf, np.inf, (1,)), [[-7.5], [8]], [[-7.5], [8]]),
    (Box(-LIMIT, LIMIT, (1,)), [[2.5]], [[2.5]]),  # bounds of the type scale nothing
    (Box(np.float32([3]), np.float32([3])), [[0.5]], [[3]]),
    (Box(-1, 1, (2, 3), np.float64), [[0] * 6] * 4, [[[0] * 3] * 2] * 4),
    (  # scaled by two bounds, clipped by one
        Box(np.float32([0, -np.inf, -1]), np.float32([4, np.inf, np.inf])),
        [[0, 7.5, 9], [-1, -7.5, -9], [0.5, 0, 0]],
        [[2, 7.5, 9], [0, -7.5, -1], [3, 0, 0]],
    ),
]


@pytest.mark.parametrize(("space", "units", "env"), ACTIONS, ids=str)
def test_what_a_policy_chooses_is_written_as_the_space_has_it(space, units, env):
    codec = action_codec(space)
    given = np.array(units, np.int64 if codec.discrete else np.float32)
    found = codec.to_env(given)
    assert (found.tolist(), found.dtype) == (env, space.dtype)
    assert given.tolist() == units, "the policy's own array was written to"
    assert np.isfinite(codec.from_env(found)).all()


@pytest.mark.parametrize(
    ("space", "parts", "size", "discrete", "multi"),
    [
        (Discrete(3), (3,), 3, True, False),
        (MultiDiscrete([[2, 3], [4, 5]]), (2, 3, 4, 5), 14, True, True),
        (MultiBinary([2, 2]), (2,) * 4, 8, True, True),
        (Box(-1, 1, (2, 3)), (), 6, False, False),
    ],
    ids=str,
)
def test_the_parts_of_an_action(space, parts, size, discrete, multi):
    codec = action_codec(space)
    assert (codec.parts, codec.size) == (parts, size)
    assert (codec.discrete, codec.multi) == (discrete, multi)


numbers = st.floats(-1e3, 1e3, width=32)


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
        edges = np.float32([-1e3, -1, 1, 1e3])[:, None].repeat(codec.size, 1)
        units = np.concatenate([units, edges])
    assert all(space.contains(row if row.shape else row[()]) for row in codec.to_env(units))


@pytest.mark.parametrize(
    "space",
    [
        *(
            Box(np.iinfo(kind).min, np.iinfo(kind).max, (2,), kind)
            for kind in (np.int8, np.uint8, np.int16, np.int32, np.int64, np.uint64)
        ),
        *(
            Box(
                np.array([-np.inf, np.finfo(kind).min, np.finfo(kind).tiny, -0.1], kind),
                np.array([np.finfo(kind).max, np.inf, 1 / 3, np.inf], kind),
                dtype=kind,
            )
            for kind in (np.float16, np.float32, np.float64)
        ),
        Box(-2.0, 3.0, (), np.float32),
        Box(0, 255, (2, 2, 3), np.uint8),
        Box(0, 255, (84, 84, 3), np.uint8),  # bounds that are all equal are one number
        Discrete(np.int64(4), start=np.int64(-2)),
        MultiDiscrete([[2, 3], [4, 5]], start=[[0, 1], [2, 3]]),
        MultiBinary(3),
        MultiBinary([2, 3]),
        MultiDiscrete([2, 3], dtype=np.int8),
        Dict([("z", Discrete(2)), ("a", Tuple((Box(-1, 1, (2,)), MultiBinary(2))))]),
    ],
    ids=str,
)
def test_a_space_survives_json(space):
    text = json.dumps(space_to_json(space), allow_nan=False, sort_keys=True)
    assert len(text) < 1000
    back = space_from_json(json.loads(text))
    assert same_space(space, back)
    assert back == space
    assert back.dtype == space.dtype
    if isinstance(space, Dict):
        assert list(back.spaces) == list(space.spaces)
    if isinstance(space, Box):
        assert np.array_equal(back.bounded_below, space.bounded_below)


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


def parts(*names, choices=2, numbers=np.float32):
    return Dict([(name, Tuple((Discrete(choices), Box(-1, 1, (2,), numbers)))) for name in names])


PIXELS = Box(0, 255, (8, 8, 3), np.uint8)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (Box(-1, 1, (2,)), Box(-9, 9, (2,)), True),
        (Box(-1, 1, (2,)), Box(-1, 1, (3,)), False),
        (Discrete(3), Discrete(3), True),
        (Discrete(3), Discrete(4), False),
        (Discrete(3), MultiBinary(3), False),
        (Discrete(3), Discrete(3, start=1), False),  # another action altogether
        (MultiDiscrete([2, 3]), MultiDiscrete([3, 2]), False),
        (parts("a", "b"), parts("a", "b"), True),
        (parts("a", "b"), parts("b", "a"), False),
        (parts("a"), parts("b"), False),
        (parts("a"), parts("a", "b"), False),
        (parts("a"), parts("a", choices=3), False),
        (parts("a"), parts("a", numbers=np.float64), False),  # other bytes
        (parts("a"), Tuple((Discrete(2),)), False),
        (PIXELS, PIXELS, True),
        (PIXELS, Box(0, 1, (8, 8, 3), np.float32), False),
        (PIXELS, Box(-np.inf, np.inf, (8, 8, 3)), False),  # a vector
    ],
    ids=str,
)
def test_spaces_are_the_same_if_a_policy_of_one_can_act_in_the_other(one, other, same):
    assert same_space(one, other) == same
