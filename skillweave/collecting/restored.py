"""Whether what a checkpoint says of open episodes and calls can be gone on from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.collecting.calls import SkillSet, skills_below
from skillweave.spaces import obs_codec, to_tensor
from skillweave.types import Array, Memory, prefixed


def check_numbers(kept: Mapping[str, Array], ranges: Mapping[str, range]) -> None:
    """Raise a ValueError where numbers are none that a collector keeps.

    Args:
        kept: of each environment, (N, …) each.
        ranges: by name, what numbers that choose among something may be.
    """
    for name, those in ranges.items():
        found = kept[name]
        if found.min(initial=those[0]) < those[0] or found.max(initial=those[0]) > those[-1]:
            raise ValueError(
                f"{name!r} of open episodes is {found.tolist()}, not from {those[0]} to {those[-1]}"
            )
    for name, found in kept.items():
        own = not name.startswith("skills.")  # what a user's policy remembers may be anything
        if own and found.dtype.kind == "f" and bool(np.isnan(found).any()):
            raise ValueError(f"{name!r} of open episodes holds NaN")


def opened(
    open_calls: Mapping[str, Array],
    kept: Mapping[str, Array],
    obs: Array,
    observation_space: gym.Space[Any],
) -> Memory:
    """What a checkpoint says of open calls, copied; observations as the environments have them.

    Args:
        open_calls: (N, …) each; observations that are structured as bytes.
        kept: of each environment, to know whether calls are open.
        obs: (N, *obs_shape), what the environments show now.

    Raises:
        ValueError: it is not of these environments.
    """
    found, codec = {}, obs_codec(observation_space)
    for name, value in open_calls.items():
        if name.replace("/", ".").rpartition(".")[2] == "obs":
            found[name] = value.copy().view(obs.dtype).reshape(obs.shape)
            codec.check(to_tensor(found[name]))
            continue
        if value.ndim != 2 or len(value) != len(obs) or value.dtype != np.float32:
            raise ValueError(f"{name!r} of open calls is {value.dtype} {value.shape}")
        if np.isnan(value).any():
            raise ValueError(f"{name!r} of open calls holds NaN")
        found[name] = value.copy()
    if "over" in kept:
        runs = ~kept["over"]
        if runs.any() and "obs" not in found:
            raise ValueError("it does not say where open calls began")
        if (kept["skills.skill"][runs] < 0).any():
            raise ValueError("a call is open, and no skill runs")
    return found


def ranges_of(skills: SkillSet) -> dict[str, range]:
    """What numbers in the memory of skills may be, by name; of those below them, too."""
    found = {"skill": range(-1, len(skills.skills))}
    for i, policy in enumerate(skills.policies):
        below, guide = skills_below(policy), getattr(policy, "guide", None)
        if below is not None:
            found |= prefixed(str(i), ranges_of(below) | ranges_of_guide(guide))
    return found


def ranges_of_guide(guide: Any | None) -> dict[str, range]:
    """The same of what a ready selector remembers."""
    return {} if guide is None else prefixed("guide", guide.selector.ranges)
