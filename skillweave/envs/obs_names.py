"""Names of the numbers in an observation, for charts and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeAlias

import gymnasium as gym

from skillweave.schema import Check, fitted

ObsNames: TypeAlias = Sequence[str] | Mapping[str, Sequence[str]]
"""A name for each number of a flat observation; for a Dict, such names by key."""


def _differ(names: Any) -> bool:
    each = names.values() if isinstance(names, Mapping) else [names]
    return all(len({*part} - {""}) == len(part) for part in each)


Names = Annotated[
    ObsNames,
    Check(
        "a list with a name of its own for each number of an observation, or for a Dict such "
        'lists by key: {"place": ["x", "y"]}',
        _differ,
    ),
]
"""Names of the numbers of an observation, as users give them."""

GYMNASIUM: dict[str, tuple[str, ...]] = {
    "Acrobot": (
        "cos of joint 1",
        "sin of joint 1",
        "cos of joint 2",
        "sin of joint 2",
        "angular speed 1",
        "angular speed 2",
    ),
    "CartPole": ("cart position", "cart speed", "pole angle", "pole angular speed"),
    "LunarLander": (
        "x",
        "y",
        "x speed",
        "y speed",
        "angle",
        "angular speed",
        "left leg",
        "right leg",
    ),
    "MountainCar": ("position", "speed"),
    "MountainCarContinuous": ("position", "speed"),
    "Pendulum": ("cos of angle", "sin of angle", "angular speed"),
}
"""Names in Gymnasium's environments by id without version, from its documentation."""


def names_in(env: gym.Env[Any, Any], env_id: str | None) -> ObsNames | None:
    """Return the names in an environment's attribute, or those that Gymnasium documents.

    Args:
        env: may have an attribute ``obs_names``; an outer wrapper's takes precedence.
        env_id: its id, if no wrapper of the user changes observations.
    """
    try:
        names = env.get_wrapper_attr("obs_names")
    except AttributeError:
        names = None
    if names is not None:
        where = f"{type(env.unwrapped).__name__}: obs_names"
        found: ObsNames = fitted(Names, names, where)
        return found
    return GYMNASIUM.get((env_id or "").rpartition("-v")[0])
