"""Spaces as JSON, and the comparison of spaces for policies."""

from __future__ import annotations

import math
from typing import Annotated, Any, NotRequired, TypedDict

import gymnasium as gym
import numpy as np

from skillweave.errors import EnvError, RunError
from skillweave.policies.files import shown
from skillweave.policies.spaces import Space
from skillweave.schema import LARGEST, AtLeastOne, Check, fit
from skillweave.spaces.choices import ChoiceSpace
from skillweave.spaces.observations import image_layout
from skillweave.spaces.packing import OBSERVATIONS, obs_dtype, parts
from skillweave.types import Array

_MOST = 10**8
"""The most numbers of one space: a damaged shape must not take all memory."""


def _is_whole(data: Any) -> bool:
    """Return whether data is a whole number, or lists of such."""
    if isinstance(data, list):
        return all(_is_whole(x) for x in data)
    return type(data) is int and abs(data) < LARGEST


def _is_shape(data: Any) -> bool:
    sizes = data if isinstance(data, list) else [data]
    return all(type(n) is int and n >= 0 for n in sizes) and math.prod(sizes) <= _MOST


_SIZES = Check(f"sizes, of at most {_MOST:,} numbers in all", _is_shape)
_Whole = Annotated[Any, Check("whole numbers below 2^63", _is_whole)]


class _Tuple(TypedDict):
    spaces: list[Any]


class _Dict(TypedDict):
    spaces: list[tuple[str, Any]]


class _Choices(TypedDict):
    choices: AtLeastOne
    goals: list[tuple[str, Any, int, int]]


class _Box(TypedDict):
    shape: Annotated[list[Any], _SIZES]
    dtype: str
    low: Any
    high: Any


class _Discrete(TypedDict):
    n: AtLeastOne
    start: int
    dtype: NotRequired[str]


class _MultiDiscrete(TypedDict):
    nvec: _Whole
    start: _Whole
    dtype: NotRequired[str]


class _MultiBinary(TypedDict):
    n: Annotated[Any, _SIZES]


_SCHEMAS: dict[str, Any] = {
    "Dict": _Dict,
    "Choices": _Choices,
    "Tuple": _Tuple,
    "Box": _Box,
    "Discrete": _Discrete,
    "MultiDiscrete": _MultiDiscrete,
    "MultiBinary": _MultiBinary,
}


def space_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """Convert a supported space to plain JSON; infinities become strings, equal bounds a number.

    Raises:
        EnvError: the space is not supported; the message names supported ones.
    """
    match space:
        case ChoiceSpace():
            goals = [
                [name, space_to_json(part), *space.owners[name]]
                for name, part in space.goal_spaces.items()
            ]
            return {"type": "Choices", "choices": space.choices, "goals": goals}
        case gym.spaces.Dict():
            inner = [[name, space_to_json(part)] for name, part in (parts(space) or {}).items()]
            return {"type": "Dict", "spaces": inner}
        case gym.spaces.Tuple():
            return {"type": "Tuple", "spaces": [space_to_json(part) for part in space.spaces]}
        case gym.spaces.Box():
            return {
                "type": "Box",
                "shape": list(space.shape),
                "dtype": str(space.dtype),
                "low": _bounds_to_json(space.low),
                "high": _bounds_to_json(space.high),
            }
        case gym.spaces.Discrete():
            discrete = {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
            return discrete | _dtype_to_json(space)
        case gym.spaces.MultiDiscrete():
            nvec = space.nvec.tolist()
            start = np.asarray(space.start).tolist()
            return {"type": "MultiDiscrete", "nvec": nvec, "start": start} | _dtype_to_json(space)
        case gym.spaces.MultiBinary():
            n = space.n if isinstance(space.n, int) else list(space.shape)
            return {"type": "MultiBinary", "n": n}
    raise EnvError(f"space {space} is not supported; supported are: {OBSERVATIONS}")


def space_from_json(data: Any) -> gym.Space[Any]:
    """Create a space from the JSON of ``space_to_json``.

    Raises:
        RunError: the JSON does not describe a supported space.
    """
    kind = data.get("type") if isinstance(data, dict) else None
    if not isinstance(kind, str) or kind not in _SCHEMAS:
        raise RunError(
            f"{shown(data)} is no space, or one of a type that is not supported; supported are: "
            f"{OBSERVATIONS}"
        )
    fit(_SCHEMAS[kind], data, "", "space")
    try:
        return _made(data)
    # Some of Gymnasium's checks of values are assertions.
    except (TypeError, ValueError, ArithmeticError, AssertionError, AttributeError) as error:
        raise RunError(f"not a space: {shown(data)} ({str(error)[:300]})") from error


def _made(data: dict[str, Any]) -> gym.Space[Any]:
    match data["type"]:
        case "Dict":  # of pairs: of a plain dict Gymnasium would sort the names
            return gym.spaces.Dict([(k, space_from_json(v)) for k, v in data["spaces"]])
        case "Choices":
            goals = data["goals"]
            spaces = {name: space_from_json(part) for name, part, _, _ in goals}
            owners = {name: (first, last) for name, _, first, last in goals}
            return ChoiceSpace(data["choices"], spaces, owners)
        case "Tuple":
            return gym.spaces.Tuple([space_from_json(part) for part in data["spaces"]])
        case "Box":
            shape = tuple(data["shape"])
            dtype = np.dtype(data["dtype"])
            if dtype.kind not in "biuf":
                raise ValueError(f"numbers of type {dtype}")
            with np.errstate(over="raise"):
                low, high = (_bounds_from_json(data[k], shape, dtype) for k in ("low", "high"))
            if not (low <= high).all():
                raise ValueError("low is not at most high")
            box: gym.Space[Any] = gym.spaces.Box(low, high, shape, dtype)
            return box
        case "Discrete":
            return _discrete(data["n"], data["start"], np.dtype(data.get("dtype", np.int64)))
        case "MultiDiscrete":
            kind: Any = np.dtype(data.get("dtype", np.int64)).type
            return gym.spaces.MultiDiscrete(data["nvec"], kind, start=data["start"])
    return gym.spaces.MultiBinary(data["n"])


def gym_space(space: Space) -> gym.Space[Any]:
    """Return a space of data as Gymnasium's."""
    if space.parts is not None:
        inner = [(name, gym_space(part)) for name, part in space.parts.items()]
        if space.kind == "Tuple":
            return gym.spaces.Tuple([part for _, part in inner])
        return gym.spaces.Dict(inner)
    dtype: Any = np.dtype(space.dtype)
    low, high = (np.asarray(x) for x in (space.low, space.high))
    if space.kind == "Box":
        low, high = (np.broadcast_to(x.astype(dtype), space.shape).copy() for x in (low, high))
        box: gym.Space[Any] = gym.spaces.Box(low, high, space.shape, dtype.type)
        return box
    if space.kind == "MultiBinary":
        return gym.spaces.MultiBinary(space.shape if len(space.shape) > 1 else space.shape[0])
    if space.kind == "Discrete":
        return _discrete(int(high - low + 1), int(low), dtype)
    count = np.broadcast_to(high - low + 1, space.shape).astype(np.int64)
    start = np.broadcast_to(low, space.shape).astype(np.int64)
    return gym.spaces.MultiDiscrete(count, dtype=dtype.type, start=start)


def same_space(a: gym.Space[Any], b: gym.Space[Any]) -> bool:
    """Return whether a policy for one space can act in the other: equal kind, shape and choices."""
    if type(a) is not type(b) or a.shape != b.shape:
        return False
    if isinstance(a, ChoiceSpace) and isinstance(b, ChoiceSpace):
        # Of goals the bounds matter, too: what a network puts out is scaled by them.
        return space_to_json(a) == space_to_json(b)
    inner, other = parts(a), parts(b)
    if inner is not None and other is not None:
        return (
            list(inner) == list(other)
            and all(same_space(inner[name], other[name]) for name in inner)
            and obs_dtype(a) == obs_dtype(b)  # a policy reads the parts out of bytes
        )
    if isinstance(a, gym.spaces.Discrete | gym.spaces.MultiDiscrete):
        plain = {"dtype": None}  # the type of choices does not matter
        return space_to_json(a) | plain == space_to_json(b) | plain
    layout = image_layout(a)
    if layout is None or layout != image_layout(b):
        return layout is None and image_layout(b) is None
    bounds = ((getattr(a, k), getattr(b, k)) for k in ("low", "high"))
    return all(np.array_equal(x, y) for x, y in bounds)  # pixels are scaled by them


def other_bounds(a: gym.Space[Any], b: gym.Space[Any]) -> bool:
    """Return whether numbers of two spaces, of which ``same_space`` is true, have other bounds.

    An infinite bound is not another one.
    """
    inner, other = parts(a), parts(b)
    if inner is not None and other is not None:
        return any(other_bounds(inner[name], other[name]) for name in inner)
    if not isinstance(a, gym.spaces.Box) or not isinstance(b, gym.spaces.Box):
        return False
    pairs = ((getattr(a, k).astype(float), getattr(b, k).astype(float)) for k in ("low", "high"))
    return any(
        (np.isfinite(x) & np.isfinite(y) & ~np.isclose(x, y, rtol=1e-4)).any() for x, y in pairs
    )


def _dtype_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """Return the type of a space of choices, if it is not the default."""
    return {} if space.dtype == np.int64 else {"dtype": str(space.dtype)}


def _discrete(n: int, start: int, dtype: np.dtype[Any]) -> gym.Space[Any]:
    if dtype == np.int64:  # before 1.2, Gymnasium knows no other type here, and no argument for it
        return gym.spaces.Discrete(n, start=start)
    return gym.spaces.Discrete(n, start=start, dtype=dtype.type)


def _bounds_to_json(bounds: Array) -> Any:
    values = bounds.reshape(-1)
    if values.size and (values == values[0]).all():
        return _number(values[0].item())
    return [_number(x) for x in values.tolist()]


def _bounds_from_json(data: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    if isinstance(data, list):
        return np.array([_of_type(x, dtype) for x in data], dtype).reshape(shape)
    return np.full(shape, _of_type(data, dtype), dtype)


def _of_type(value: Any, dtype: np.dtype[Any]) -> Any:
    if dtype.kind in "iu" and isinstance(value, int):  # before NumPy 2 it would become another one
        limits = np.iinfo(dtype)
        if not limits.min <= value <= limits.max:
            raise OverflowError(f"{value} is out of the range of {dtype}")
    return dtype.type(value)


def _number(x: float) -> float | str:
    return x if np.isfinite(x) else str(x)
