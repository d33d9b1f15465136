"""Spaces as JSON, and whether two are the same to a policy."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.spaces.observations import image_layout
from skillweave.spaces.packing import OBSERVATIONS, obs_dtype, parts
from skillweave.types import Array, SkillweaveError


def space_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """A supported space as plain JSON; infinities become strings, equal bounds one number.

    Raises:
        SkillweaveError: the space is not supported; the message says which are.
    """
    match space:
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
            found = {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
            return found | _dtype_to_json(space)
        case gym.spaces.MultiDiscrete():
            nvec, start = space.nvec.tolist(), np.asarray(space.start).tolist()
            return {"type": "MultiDiscrete", "nvec": nvec, "start": start} | _dtype_to_json(space)
        case gym.spaces.MultiBinary():
            n = space.n if isinstance(space.n, int) else list(space.shape)
            return {"type": "MultiBinary", "n": n}
    raise SkillweaveError(f"space {space} is not supported; supported are: {OBSERVATIONS}")


def space_from_json(data: dict[str, Any]) -> gym.Space[Any]:
    """The inverse of ``space_to_json``.

    Raises:
        SkillweaveError: the JSON does not describe a supported space.
    """
    try:
        match data["type"]:
            case "Dict":  # of pairs: of a plain dict Gymnasium would sort the names
                return gym.spaces.Dict([(k, space_from_json(v)) for k, v in data["spaces"]])
            case "Tuple":
                return gym.spaces.Tuple([space_from_json(part) for part in data["spaces"]])
            case "Box":
                shape, dtype = tuple(data["shape"]), np.dtype(data["dtype"])
                low, high = (_bounds_from_json(data[k], shape, dtype) for k in ("low", "high"))
                box: gym.Space[Any] = gym.spaces.Box(low, high, shape, dtype)
                return box
            case "Discrete":
                return gym.spaces.Discrete(data["n"], start=data["start"], **_dtype(data))
            case "MultiDiscrete":
                return gym.spaces.MultiDiscrete(data["nvec"], start=data["start"], **_dtype(data))
            case "MultiBinary":
                return gym.spaces.MultiBinary(data["n"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SkillweaveError(f"not a space: {data!r} ({error})") from error
    raise SkillweaveError(
        f"space type {data['type']!r} is not supported; supported are: {OBSERVATIONS}"
    )


def same_space(a: gym.Space[Any], b: gym.Space[Any]) -> bool:
    """Whether a policy made for one space can act in the other: same kind, shape and choices."""
    if type(a) is not type(b) or a.shape != b.shape:
        return False
    inner, other = parts(a), parts(b)
    if inner is not None and other is not None:
        return (
            list(inner) == list(other)
            and all(same_space(inner[name], other[name]) for name in inner)
            and obs_dtype(a) == obs_dtype(b)  # a policy reads the parts out of bytes
        )
    if isinstance(a, gym.spaces.Discrete | gym.spaces.MultiDiscrete):
        plain = {"dtype": None}  # choices are the same whatever the type that holds them
        return space_to_json(a) | plain == space_to_json(b) | plain
    return image_layout(a) == image_layout(b)


def _dtype_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """The type of a space of choices, where it is not the usual one."""
    return {} if space.dtype == np.int64 else {"dtype": str(space.dtype)}


def _dtype(data: dict[str, Any]) -> dict[str, Any]:
    return {"dtype": np.dtype(data["dtype"]).type} if "dtype" in data else {}


def _bounds_to_json(bounds: Array) -> Any:
    values = bounds.reshape(-1)
    if values.size and (values == values[0]).all():
        return _number(values[0].item())
    return [_number(x) for x in values.tolist()]


def _bounds_from_json(data: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    if isinstance(data, list):
        return np.array([dtype.type(x) for x in data], dtype).reshape(shape)
    return np.full(shape, dtype.type(data), dtype)


def _number(x: float) -> float | str:
    return x if np.isfinite(x) else str(x)
