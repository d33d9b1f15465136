"""Spaces as JSON, and the comparison of spaces for policies."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.errors import PolicyError, RunError
from skillweave.policies.codec import Reader, Written
from skillweave.policies.hierarchy import SKILL
from skillweave.policies.parts import GOAL
from skillweave.policies.spaces import MOST, Space, space_of
from skillweave.policies.untrusted import shown
from skillweave.schema import fit
from skillweave.spaces.choices import ChoiceSpace
from skillweave.spaces.observations import image_layout
from skillweave.spaces.packing import obs_dtype, parts


def space_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """Convert a supported space to plain JSON, as policies' files have it.

    The parts of a Dict or Tuple are pairs, as files may sort the names of an object.

    Raises:
        EnvError: the space is not supported; the message names supported ones.
    """
    obs_dtype(space)  # raises where the space is not supported
    data = _in_order(Written(small=MOST).tree(space_of(space)))
    return data | {"owners": space.owners} if isinstance(space, ChoiceSpace) else data


def _in_order(data: dict[str, Any]) -> dict[str, Any]:
    parts = data.get("parts", {}).items()
    return data | {"parts": [[name, _in_order(part)] for name, part in parts]} if parts else data


def _by_name(data: Any) -> Any:
    """Return JSON with parts by name; undo ``_in_order``."""
    if not isinstance(data, dict) or "parts" not in data:
        return data
    return data | {"parts": {name: _by_name(part) for name, part in data["parts"]}}


def space_from_json(data: Any) -> gym.Space[Any]:
    """Create a space from the JSON of ``space_to_json``.

    Raises:
        RunError: the JSON does not describe a supported space.
    """
    owners = data.get("owners") if isinstance(data, dict) else None
    try:
        plain = data if owners is None else {k: x for k, x in data.items() if k != "owners"}
        space = gym_space(Reader({}, {}, {}, MOST).read(Space, _by_name(plain), "space"))
        if owners is None:
            return space
        goals: Any = space[GOAL]  # type: ignore[index]
        numbers = fit(dict[str, tuple[int, int]], owners, "", "owners")
        own = {name: numbers[name] for name in goals.spaces}
        return ChoiceSpace(int(space[SKILL].n), goals.spaces, own)  # type: ignore[index]
    # Some of Gymnasium's checks of values are assertions.
    except (
        PolicyError,
        TypeError,
        ValueError,
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
    ) as error:
        raise RunError(f"not a space: {shown(data)} ({str(error)[:300]})") from error


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
        one, two = space_of(a), space_of(b)  # the type of choices does not matter
        return one.counts == two.counts and np.array_equal(one.bounds[0], two.bounds[0])
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


def _discrete(n: int, start: int, dtype: np.dtype[Any]) -> gym.Space[Any]:
    if dtype == np.int64:  # before 1.2, Gymnasium knows no other type here, and no argument for it
        return gym.spaces.Discrete(n, start=start)
    return gym.spaces.Discrete(n, start=start, dtype=dtype.type)
