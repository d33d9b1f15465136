"""Validate the open episodes and calls stored in a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.paths import join, level_of, name_of
from skillweave._internal.policy_protocol import Memory
from skillweave.policies.core import RUNNING, Array
from skillweave.skills.goal_spaces import with_goal
from skillweave.skills.goals import Goals
from skillweave.spaces import obs_codec, to_tensor

COUNTS = range(-1, 2**31)
"""What a number of steps or calls may be."""
OF_OTHERS = ("player.", "starters.", "last_action")
"""How names begin of what policies remember. They may be a user's, and that may be anything."""
OF_LEARNERS = {"state_before", "player.rnn", "player.own.rnn", "player.selector.rnn"}
"""What is kept of the learners' memory: others begin without."""
PLAYERS = ("player", "starters")
"""What players are called whose memory is kept."""


def known(x: Array) -> Array:
    """Return a copy with 0 for NaN: an heir of a diverged member goes on with its open calls."""
    return np.where(np.isnan(x), np.float32(0), x)


def check_numbers(
    kept: Mapping[str, Array],
    values: Mapping[str, range | Goals],
) -> None:
    """Raise a ValueError where numbers are none that a collector keeps.

    Args:
        kept: of each environment, (N, …) each.
        values: by name, what numbers may be that choose among something, or the goals that they
            are.
    """
    ranges = {name: those for name, those in values.items() if isinstance(those, range)}
    for name, of_skill in values.items():
        if not isinstance(of_skill, range) and not of_skill.contains(kept[name]):
            raise ValueError(f"{name!r} of an open call is no goal of its skill")
    own = {
        k: x
        for k, x in kept.items()
        if (k in OF_LEARNERS or not k.startswith(OF_OTHERS)) and (k not in values or k in ranges)
    }
    counts = {name: COUNTS for name, x in own.items() if x.dtype == np.int64}
    for name, those in (counts | ranges).items():
        wrong = kept[name][(kept[name] < those[0]) | (kept[name] > those[-1])]
        if len(wrong):
            raise ValueError(
                f"{name!r} of an open episode is {wrong[0]}, not from {those[0]} to {those[-1]}"
            )
    for name, x in own.items():
        if x.dtype.kind == "f" and not np.isfinite(x).all():
            raise ValueError(f"{name!r} of open episodes is not finite")
    for player in PLAYERS:
        end, skill = kept.get(f"{player}.end"), kept.get(f"{player}.skill")
        if end is not None and skill is not None and (skill[end == RUNNING] < 0).any():
            raise ValueError("a call is open, and no skill runs")


def opened(
    open_calls: Mapping[str, Array],
    kept: Mapping[str, Array],
    obs: Array,
    observation_space: gym.Space[Any],
    goals: Mapping[str, Goals],
) -> Memory:
    """Return the open calls of a checkpoint, copied; observations as the environments have them.

    Args:
        open_calls: (N, …) each; observations that are structured as bytes.
        kept: of each environment, to know whether calls are open.
        obs: (N, *obs_shape), what the environments show now.
        goals: by the names of observations, those of the hierarchies that observe them, too.

    Raises:
        ValueError: it is not of these environments.
    """
    found = {}
    plain = obs_codec(observation_space)
    for name, value in open_calls.items():
        if name_of(name) == "obs":  # of a hierarchy below: "inner/obs"
            like = obs
            codec = plain
            if (own := goals.get(name)) is not None:
                like = own.join(obs, own.start(len(obs)))
                codec = obs_codec(with_goal(observation_space, own.goal_space))
            found[name] = value.copy().view(like.dtype).reshape(like.shape)
            # What calls that are over were decided on is not kept.
            is_open = kept[join(level_of(name), "open")]
            codec.check(to_tensor(found[name][is_open]))
            continue
        if name_of(name) == "action" and value.dtype == np.int64 and value.shape == obs.shape[:1]:
            found[name] = value.copy()  # the numbers of skills with their goals
            if (value < 0).any():
                raise ValueError(f"{name!r} of open calls is {value.min()}, which is no choice")
            continue
        if value.ndim != 2 or len(value) != len(obs) or value.dtype != np.float32:
            raise ValueError(f"{name!r} of open calls is {value.dtype} {value.shape}")
        found[name] = known(value)
        if not np.isfinite(found[name]).all():
            raise ValueError(f"{name!r} of open calls is not finite")
    running = kept.get("player.end", np.ones(1, np.int8)) == RUNNING
    if "tau" in kept and running.any() and "obs" not in found:
        raise ValueError("it does not say where open calls began")
    return found
