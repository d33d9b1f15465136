"""Functions that several recipes use for their environments and skills."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym

from skillweave import EnvSpec, Hierarchy


def named(name: str, make: Callable[..., gym.Env[Any, Any]], pool: Any = None) -> EnvSpec:
    """Return environments under a name of their own in runs, for ``Hierarchy(env=...)``.

    Args:
        make: takes ``render_mode``.
        pool: makes them side by side; see ``EnvSpec``.
    """

    def one(render_mode: str | None = None) -> gym.Env[Any, Any]:
        return make(render_mode=render_mode)

    one.__name__ = name
    return EnvSpec(one, pool=pool)


class OwnTask(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that pays otherwise, so that nothing is solved at the environment's threshold."""

    @property
    def spec(self) -> Any:  # type: ignore[override]  # Gymnasium has it so, too
        """Return the environment's spec, without the return at which that is solved."""
        spec = super().spec
        return spec and replace(spec, reward_threshold=None)


def given(hierarchy: Hierarchy, skills: Mapping[str, Any]) -> Hierarchy:
    """Return the hierarchy with policies of its skills, by name; only the selector learns."""
    for skill in hierarchy.skills:
        skill.policy = skills[skill.name]
        skill.steps = None  # it is not trained
    return hierarchy
