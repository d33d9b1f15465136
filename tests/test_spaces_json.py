"""The bounds of every number type survive JSON."""

import json

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Tuple

from skillweave.spaces import space_from_json, space_to_json


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.int32, np.int64, np.uint64])
def test_integer_boxes_as_wide_as_their_type_survive_json(dtype):
    limits = np.iinfo(dtype)
    space = Box(limits.min, limits.max, (2,), dtype)
    back = space_from_json(json.loads(json.dumps(space_to_json(space), allow_nan=False)))
    assert back == space
    assert (back.high > back.low).all()


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_real_boxes_bounded_and_not_survive_json(dtype):
    limits = np.finfo(dtype)
    low = np.array([-np.inf, limits.min, limits.tiny, -0.1], dtype)
    high = np.array([limits.max, np.inf, 1 / 3, np.inf], dtype)
    space = Box(low, high, dtype=dtype)
    back = space_from_json(json.loads(json.dumps(space_to_json(space), allow_nan=False)))
    assert back == space
    assert back.dtype == dtype
    assert back.bounded_below.tolist() == space.bounded_below.tolist()


def test_a_box_without_axes_survives_json():
    space = Box(-2.0, 3.0, (), np.float32)
    back = space_from_json(json.loads(json.dumps(space_to_json(space))))
    assert back == space
    assert back.shape == ()


def test_bounds_that_are_all_equal_are_one_number():
    pixels = Box(0, 255, (84, 84, 3), np.uint8)
    text = json.dumps(space_to_json(pixels))
    assert len(text) < 200
    assert space_from_json(json.loads(text)) == pixels


def test_the_names_of_a_dict_keep_their_order():
    space = Dict([("z", Discrete(2)), ("a", Discrete(3)), ("m", Tuple((Discrete(4),)))])
    back = space_from_json(json.loads(json.dumps(space_to_json(space), sort_keys=True)))
    assert list(back.spaces) == ["z", "a", "m"]
    assert back == space


def test_what_is_written_is_plain_json_without_numpys_numbers():
    text = json.dumps(space_to_json(Discrete(np.int64(3), start=np.int64(-1))), allow_nan=False)
    assert space_from_json(json.loads(text)) == Discrete(3, start=-1)
