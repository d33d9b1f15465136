"""Names of the numbers in an observation, for charts and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium as gym

from skillweave.errors import DeclarationError
from skillweave.messages import short

ObsNames: TypeAlias = Sequence[str] | Mapping[str, Sequence[str]]
"""A name for each number of a flat observation; for a Dict, such names by key."""

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


def checked_obs_names(names: object, where: str) -> ObsNames | None:
    """Return the names, if they are texts in a list, or such lists by key.

    Raises:
        DeclarationError: they are not; the message begins with ``where``.
    """
    if names is None:
        return None
    parts: list[Any] = list(names.values()) if isinstance(names, Mapping) else [names]
    for part in parts:
        listed = isinstance(part, Sequence) and not isinstance(part, str)
        if not listed or not all(isinstance(name, str) and name for name in part):
            raise DeclarationError(
                f"{where}: obs_names is {short(names)}; it must be a list with a name for each "
                'number of an observation, or for a Dict such lists by key: {"place": ["x", "y"]}'
            )
        if len(set(part)) < len(part):
            raise DeclarationError(f"{where}: obs_names has a name twice: {short(part)}")
    return names  # type: ignore[return-value]


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
        return checked_obs_names(names, type(env.unwrapped).__name__)
    return GYMNASIUM.get((env_id or "").rpartition("-v")[0])
