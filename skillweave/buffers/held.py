"""Whether rows that a checkpoint holds, of either store, can be learnt from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.spaces import ActionCodec, ObsCodec, obs_codec, obs_dtype, obs_shape, to_tensor
from skillweave.types import Array

DTYPES = {
    "reward": torch.float32, "steps": torch.int64, "terminated": torch.bool, "last": torch.bool,
    "valid": torch.bool, "advantage": torch.float32, "episode_start": torch.bool,
    "overridden": torch.bool, "call_start": torch.bool, "mask": torch.bool,
    "dist_params": torch.float32, "guide": torch.float32, "recurrent_state": torch.float32,
    "log_std": torch.float32, "env_reward": torch.float32,
}  # fmt: skip
"""Of all fields but observations and actions."""
NEEDED = {"obs", "next_obs", "action", "reward", "steps", "terminated", "last", "valid"}
ONE_ROW = ("recurrent_state", "log_std")
"""Fields that have one row, however many there are of the others."""
VECTORS = ("mask", "dist_params", "guide", *ONE_ROW)
"""Fields that have several numbers for each row."""


LARGEST_STEPS = 2**31
"""No row has as many."""
SLICE = 1 << 16
"""Rows of a replay buffer that are looked at at once, so that no copy of all is made."""


def check_held(
    held: Sequence[Mapping[str, Tensor]],
    members: int,
    observation_space: gym.Space[Any],
    codec: ActionCodec,
) -> None:
    """Raise a ValueError where rows do not fit together, or into the spaces of who learns.

    Args:
        held: of each experience, fields (P, T, B, …).
        members: P.
        codec: of the actions.
    """
    obs = to_tensor(np.zeros((1, *obs_shape(observation_space)), obs_dtype(observation_space)))
    seen = obs_codec(observation_space)
    for rows in held:
        # Where all actions are allowed, an experience has no mask.
        names, first = rows.keys() - {"mask"}, held[0].keys() - {"mask"}
        if names != first or not NEEDED <= names <= NEEDED | DTYPES.keys():
            raise ValueError(f"its rows hold {', '.join(sorted(rows))}")
        lead = rows["valid"].shape
        if len(lead) != 3 or lead[0] != members or 0 in lead:
            raise ValueError(f"its rows are {tuple(lead)} for {members} members")
        for name, x in rows.items():
            _check_field(name, x, lead, obs, codec)
        for name in ("obs", "next_obs"):
            seen.check(rows[name])
        codec.check(rows["action"])
        steps = rows["steps"]
        if not bool(((steps >= 1) & (steps < LARGEST_STEPS)).all()):
            raise ValueError("a row of it took no step, or more than there are")


def _check_field(
    name: str, x: Tensor, lead: tuple[int, ...], obs: Tensor, codec: ActionCodec
) -> None:
    """Dtype, shape, and that all are numbers."""
    dtype, item = DTYPES.get(name), tuple(x.shape[3:]) if name in VECTORS else ()
    if name in ("obs", "next_obs"):
        dtype, item = obs.dtype, tuple(obs.shape[1:])
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
        written: as of ``Columns.written``.
        actions: how many there are; 0: they are no numbers of actions.
    """
    w, steps = written, written.get("steps", np.ones(1))
    action, newest, held = w["action"], w["newest"], w["kind"] > 0
    some = held.reshape(-1, len(newest)).any(0)  # of each column
    checks = [
        ("kind", (w["kind"] <= 2).all() and (some == (newest >= 0)).all()),
        ("newest", ((newest >= -1) & (newest < 2**53)).all()),
        ("action", not actions or action.dtype.kind not in "iu"
         or ((action >= 0) & (action < actions)).all()),
        ("steps", ((steps >= 1) & (steps < LARGEST_STEPS)).all()),
        *((name, np.isfinite(x).all())
          for name, x in w.items() if x.dtype.kind == "f" and name != "obs"),
    ]  # fmt: skip
    if "call" in w:
        call, room = w["call"][held], len(w["rewards"])
        checks.append(("call", ((call >= 0) & (call + steps[held] <= room)).all()))
    if wrong := [name for name, right in checks if not right]:
        raise ValueError(f"{wrong[0]!r} of its replay buffer is out of range")
    _check_observations(w["obs"], newest, obs_codec(observation_space))


def _check_observations(obs: Array, newest: Array, codec: ObsCodec) -> None:
    """Look at the observations of slots that were written to."""
    if not codec.may_be_wrong:
        return
    rows = np.arange(len(obs) // len(newest))[:, None] <= newest
    for first in range(0, len(obs), SLICE):
        part = slice(first, first + SLICE)
        codec.check(to_tensor(obs[part][rows.ravel()[part]]))
