"""A batch of observations as one NumPy array, for any space.

Dict and Tuple become structured arrays, so that ``obs[rows]``, ``obs[rows] = x`` and
``obs.copy()`` mean the same for every space, and ``obs["position"]`` is a part.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave.errors import EnvError
from skillweave.policies.core import Array
from skillweave.policies.spaces import at

OBSERVATIONS = "Box, Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of these"


LARGEST = 1_000_000
"""The most numbers in an observation or an action of a network; pixels may be 16 times as many."""


def check_size(space: gym.Space[Any], what: str, numbers: int, largest: int = LARGEST) -> None:
    """Raise an EnvError where a network would need too many numbers for a space.

    The first layer alone has a weight for each number and each unit, and the optimiser stores two
    more numbers for each weight.
    """
    if numbers > largest:
        gigabytes = numbers * 64 * 4 * 3 / 1e9
        raise EnvError(
            f"{what} space {short(space)} is {numbers:,} numbers to a network, choices one-hot; at "
            f"most {largest:,} are supported: 64 units that take them all in would need "
            f"{gigabytes:,.1f} GB. Wrap the environment so that it has fewer numbers"
        )


def parts(space: gym.Space[Any]) -> dict[str, gym.Space[Any]] | None:
    """Return the named parts of a Dict or Tuple, in order; None for any other space.

    Raises:
        EnvError: it has no parts, or their names are not text.
    """
    if isinstance(space, gym.spaces.Dict):
        named = dict(space.spaces)
    elif isinstance(space, gym.spaces.Tuple):
        named = {str(i): part for i, part in enumerate(space.spaces)}
    else:
        return None
    if not named or not all(isinstance(name, str) and name for name in named):
        raise EnvError(f"space {space} needs at least one part, each with text as its name")
    return named


def leaf_spaces(space: gym.Space[Any]) -> dict[tuple[str, ...], Any]:
    """Return the innermost parts of a space, in order, by the names that lead to them."""
    inner = parts(space)
    if inner is None:
        return {(): space}
    return {
        (name, *path): leaf
        for name, part in inner.items()
        for path, leaf in leaf_spaces(part).items()
    }


def obs_shape(space: gym.Space[Any]) -> tuple[int, ...]:
    """Return the shape of one observation in a batch; () for Dict and Tuple."""
    return tuple(space.shape or ())


def obs_dtype(space: gym.Space[Any]) -> np.dtype[Any]:
    """Return the dtype of observations; a structured one for Dict and Tuple.

    Raises:
        EnvError: the space is not supported; the message names supported ones, and what to do. Or
            two of its parts have one name.
    """
    dtype = _dtype(space, space, ())
    if dtype.names is not None:
        _check_names(space)
    return dtype


def _check_names(space: gym.Space[Any]) -> None:
    """Raise an EnvError where two parts have one name: ``a.b``, and ``b`` in ``a``."""
    paths: dict[str, tuple[str, ...]] = {}
    for path in leaf_spaces(space):
        name = ".".join(path)
        if name in paths:
            both = " and ".join("".join(f"[{key!r}]" for key in p) for p in (paths[name], path))
            raise EnvError(
                f"two parts of space {short(space, 200)} are both called {name!r} ({both}): "
                "let the environment call one of them otherwise"
            )
        paths[name] = path


def _dtype(space: gym.Space[Any], whole: gym.Space[Any], place: tuple[str, ...]) -> np.dtype[Any]:
    """Return the dtype of the part of ``whole`` with these names."""
    inner = parts(space)
    if inner is None:
        kinds = gym.spaces.MultiDiscrete | gym.spaces.MultiBinary
        if isinstance(space, gym.spaces.Box | gym.spaces.Discrete | kinds):
            dtype = np.dtype(space.dtype)
            if dtype.kind == "f" and dtype.itemsize > 8:
                wrapper = "lambda env: gymnasium.wrappers.DtypeObservation(env, numpy.float64)"
                what = (
                    f"the part {'.'.join(place)} of the observation space"
                    if place
                    else (f"observation space {short(space)}")
                )
                advice = (
                    "let the environment give float64 there"
                    if place
                    else f"convert it: EnvSpec(env, wrappers=({wrapper},))"
                )
                raise EnvError(f"{what} is of {dtype}, which PyTorch does not have; {advice}")
            return dtype
        raise EnvError(_unsupported(space, whole, place))
    fields = [
        (name, _dtype(part, whole, (*place, name)), obs_shape(part)) for name, part in inner.items()
    ]
    # Aligned, so that a part can be read out of the raw bytes without a copy.
    return np.dtype(fields, align=True)


def _unsupported(space: gym.Space[Any], whole: gym.Space[Any], place: tuple[str, ...]) -> str:
    """Return the error message of an unsupported part of ``whole`` with these names."""
    shown = " ".join(short(space).split())
    what = f"observation space {shown}"
    if place:
        what = f"the part {'.'.join(place)} of the observation space, {shown},"
    begin = f"{what} is not supported; supported are: {OBSERVATIONS}. "
    wrap = "EnvSpec(env, wrappers=(lambda env: gymnasium.wrappers.{},))"
    inner = parts(whole) or {}
    others = [name for name in inner if name != place[0] and _is_supported(inner[name])]
    if others and isinstance(whole, gym.spaces.Dict):
        return begin + f"Leave it out: {wrap.format(f'FilterObservation(env, {others})')}"
    try:
        flat = gym.spaces.utils.flatten_space(whole)
    except Exception:  # a space of the user's own
        flat = None
    if isinstance(flat, gym.spaces.Box) and flat.shape != (0,):
        return begin + f"Make a vector of it: {wrap.format('FlattenObservation(env)')}"
    return begin + (
        "Let a function make numbers of it: "
        + wrap.format("TransformObservation(env, function, gymnasium.spaces.Box(...))")
    )


def _is_supported(space: gym.Space[Any]) -> bool:
    """Return whether observations of a space can be packed into one array."""
    try:
        obs_dtype(space)
    except EnvError:
        return False
    return True


def pack(space: gym.Space[Any], batched: Any) -> Array:
    """Pack a batch of Gymnasium (dicts and tuples of arrays) into one array (*lead, *obs_shape).

    An array is returned unchanged.
    """
    if isinstance(batched, np.ndarray) or parts(space) is None:
        return np.asarray(batched)
    values = {}
    for path, leaf in leaf_spaces(space).items():
        value = batched
        for name in path:
            value = value[int(name)] if isinstance(value, tuple | list) else value[name]
        values[path] = value
        lead = np.shape(value)[: np.ndim(value) - len(obs_shape(leaf))]
    # Zeros, because the bytes between parts are written to files, which must be reproducible.
    packed = np.zeros(lead, obs_dtype(space))
    for path, value in values.items():
        at(packed, path)[...] = value
    return packed


def put_observation(space: gym.Space[Any], out: Array, row: int, obs: Any) -> None:
    """Write an observation of an environment into a row of a batch (n, *obs_shape).

    Raises:
        ValueError: it has another shape.
        KeyError, TypeError, IndexError: a part is missing.
    """
    if isinstance(space, gym.spaces.Dict):
        for key, part in space.spaces.items():
            put_observation(part, out[key], row, obs[key])
        return
    if isinstance(space, gym.spaces.Tuple):
        for i, part in enumerate(space.spaces):
            put_observation(part, out[str(i)], row, obs[i])
        return
    given = np.asarray(obs)
    if given.shape != out.shape[1:]:
        raise ValueError(f"it has shape {given.shape}, not {out.shape[1:]}")
    out[row] = given


def unpack(space: gym.Space[Any], array: Array) -> Any:
    """Unpack an array of ``pack`` to dicts and tuples of views; return a plain array unchanged."""
    inner = parts(space)
    if inner is None:
        return array
    values = {name: unpack(part, array[name]) for name, part in inner.items()}
    return tuple(values.values()) if isinstance(space, gym.spaces.Tuple) else values


def leaves(obs: Array) -> Iterator[Array]:
    """Yield the innermost parts of observations (n, ...), which share their memory."""
    for name in obs.dtype.names or ():
        yield from leaves(obs[name])
    if obs.dtype.names is None:
        yield obs
