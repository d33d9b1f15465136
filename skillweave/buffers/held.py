"""Checks of the rows that a checkpoint holds, of either store, before a learner uses them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.policies.core import Array
from skillweave.spaces import ActionCodec, ObsCodec, obs_codec, obs_dtype, obs_shape, to_tensor

DTYPES = {
    "reward": torch.float32,
    "steps": torch.int64,
    "terminated": torch.bool,
    "last": torch.bool,
    "valid": torch.bool,
    "advantage": torch.float32,
    "episode_start": torch.bool,
    "overridden": torch.bool,
    "call_start": torch.bool,
    "mask": torch.bool,
    "dist_params": torch.float32,
    "guide": torch.float32,
    "recurrent_state": torch.float32,
    "log_std": torch.float32,
    "env_reward": torch.float32,
}
"""Types of all fields but observations and actions."""
NEEDED = {"obs", "next_obs", "action", "reward", "steps", "terminated", "last", "valid"}
ONE_ROW = ("recurrent_state", "log_std")
"""Fields that have one row, whatever the number of rows of the others."""
VECTORS = ("mask", "dist_params", "guide", *ONE_ROW)
"""Fields that have several numbers for each row."""
LARGEST_STEPS = 2**31
"""Upper limit of a row's steps, exclusive."""
SLICE = 1 << 16
"""Rows of a replay buffer that are checked at once, so that no copy of all is made."""


def check_held(
    held: Sequence[Mapping[str, Tensor]],
    members: int,
    observation_space: gym.Space[Any],
    codec: ActionCodec,
) -> None:
    """Raise a ValueError where rows do not fit together, or into the learner's spaces.

    Args:
        held: the fields (P, T, B, …) of each batch.
        members: P.
        codec: the codec of the actions.
    """
    obs = to_tensor(np.zeros((1, *obs_shape(observation_space)), obs_dtype(observation_space)))
    observations = obs_codec(observation_space)
    for rows in held:
        # A batch in which all actions are allowed has no mask.
        names = rows.keys() - {"mask"}
        first = held[0].keys() - {"mask"}
        if names != first or not NEEDED <= names <= NEEDED | DTYPES.keys():
            raise ValueError(f"its rows hold {', '.join(sorted(rows))}")
        lead = rows["valid"].shape
        if len(lead) != 3 or lead[0] != members or 0 in lead:
            raise ValueError(f"its rows are {tuple(lead)} for {members} members")
        for name, x in rows.items():
            _check_field(name, x, lead, obs, codec)
        for name in ("obs", "next_obs"):
            observations.check(rows[name])
        codec.check(rows["action"])
        steps = rows["steps"]
        if not bool(((steps >= 1) & (steps < LARGEST_STEPS)).all()):
            raise ValueError("a row of it has less than 1 step, or too many")


def _check_field(
    name: str, x: Tensor, lead: tuple[int, ...], obs: Tensor, codec: ActionCodec
) -> None:
    """Check a field's dtype and shape, and that its numbers are finite."""
    dtype = DTYPES.get(name)
    item = tuple(x.shape[3:]) if name in VECTORS else ()
    if name in ("obs", "next_obs"):
        dtype = obs.dtype
        item = tuple(obs.shape[1:])
    elif name == "action":
        dtype = torch.int64 if codec.discrete else torch.float32
        width = len(codec.parts) if codec.discrete else codec.size
        item = () if codec.discrete and not codec.multi else (width,)
    rows = 1 if name in ONE_ROW else lead[1]
    columns = {lead[2], 1} if name == "log_std" else {lead[2]}
    shapes = [(lead[0], rows, n, *item) for n in columns]
    if x.dtype != dtype or tuple(x.shape) not in shapes or (name in VECTORS and len(item) != 1):
        raise ValueError(f"{name!r} of its rows is {x.dtype} {tuple(x.shape)}")
    if name in DTYPES and x.is_floating_point() and not bool(x.isfinite().all()):
        raise ValueError(f"{name!r} of its rows is not finite")


def check_columns(
    written: Mapping[str, Array], observation_space: gym.Space[Any], actions: int
) -> None:
    """Raise a ValueError where numbers of a replay buffer are out of range.

    Args:
        written: the result of ``Columns.written``.
        actions: the number of discrete actions; 0: actions are continuous.
    """
    steps = written.get("steps", np.ones(1))
    kind = written["kind"]
    action = written["action"]
    newest = written["newest"]
    transition = kind > 0
    filled = transition.reshape(-1, len(newest)).any(0)  # (N,), columns with a transition
    in_range = {
        "kind": (kind <= 2).all() and (filled == (newest >= 0)).all(),
        "newest": ((newest >= -1) & (newest < 2**53)).all(),
        "action": not actions or ((action >= 0) & (action < actions)).all(),
        "steps": ((steps >= 1) & (steps < LARGEST_STEPS)).all(),
    }
    for name, x in written.items():
        if x.dtype.kind == "f" and name != "obs":
            in_range[name] = in_range.get(name, True) and np.isfinite(x).all()
    if "call" in written:
        call = written["call"][transition]
        room = len(written["rewards"])
        in_range["call"] = ((call >= 0) & (call + steps[transition] <= room)).all()
    if wrong := [name for name, right in in_range.items() if not right]:
        raise ValueError(f"{wrong[0]!r} of its replay buffer is out of range")
    _check_observations(written["obs"], newest, obs_codec(observation_space))


def _check_observations(obs: Array, newest: Array, codec: ObsCodec) -> None:
    """Check the observations of the slots that were written."""
    if not codec.may_be_wrong:
        return
    is_written = np.arange(len(obs) // len(newest))[:, None] <= newest
    for first in range(0, len(obs), SLICE):
        part = slice(first, first + SLICE)
        codec.check(to_tensor(obs[part][is_written.ravel()[part]]))
