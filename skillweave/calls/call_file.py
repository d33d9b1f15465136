"""Files of call logs: safetensors, read with checks, so that a foreign file cannot do harm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave._internal.messages import as_path
from skillweave._internal.rewards import LARGEST_REWARD
from skillweave.algorithms.batches import INFO
from skillweave.calls.columns import (
    GOAL,
    CallColumns,
    call_fields,
    columns_of,
    fields_of,
)
from skillweave.errors import RunError, SkillweaveError
from skillweave.policies.core import Array, CallEnd
from skillweave.runs.files import read_tensors, record_in, write_tensors
from skillweave.runs.user_code import Texts
from skillweave.schema import AtLeastOne, Count
from skillweave.skills.base import NAME
from skillweave.spaces import (
    leaves,
    obs_codec,
    obs_dtype,
    obs_shape,
    space_from_json,
    space_to_json,
    to_tensor,
)

PER_SKILL = ("checksums", "sees", "recurrent", "own_success")
"""Fields with a value for each skill."""
PLAIN = ("skills", "lengths", *PER_SKILL, "code", "limits")
"""Fields that the header has as they are."""
RANGES: dict[str, tuple[float, float]] = {
    "end_reason": (1, max(CallEnd)),
    "episode": (0, 2**62 - 1),
    "seed": (-1, 2**31 - 1),
    "order": (0, 2**31 - 1),
    "age": (0, 2**31 - 1),
    "reward": (-LARGEST_REWARD, LARGEST_REWARD),
}
"""The least and the largest number in a column."""


@dataclass(frozen=True)
class LoggedRun:
    """The run whose calls a log in its directory holds."""

    id: str | None
    skills: str
    """Checksum of the weights of all its skills."""


@dataclass(frozen=True, kw_only=True)
class CallsHeader:
    """The header of a log's file."""

    kind: Literal["calls"] = "calls"
    skills: tuple[str, ...]
    lengths: tuple[AtLeastOne, ...]
    checksums: tuple[str, ...]
    sees: tuple[tuple[Count, ...] | None, ...]
    recurrent: tuple[bool, ...]
    own_success: tuple[bool, ...]
    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    info: tuple[str, ...]
    goals: tuple[str, ...]
    """The skills that have goals."""
    code: Texts
    limits: tuple[AtLeastOne | None, ...] = ()
    run: LoggedRun | None = None


def write_calls(path: str | Path, log: CallColumns, run: LoggedRun | None = None) -> None:
    """Write a log of calls into a file.

    Args:
        run: the run in whose directory the file is; None: in none.

    Raises:
        RunError: the file cannot be written.
    """
    header = CallsHeader(
        **{name: getattr(log, name) for name in PLAIN},
        observation_space=space_to_json(log.observation_space),
        action_space=space_to_json(log.action_space),
        info=tuple(log.info),
        goals=tuple(log.goals),
        run=run,
    )
    tensors = {name: to_tensor(value) for name, value in columns_of(log).items()}
    write_tensors(as_path(path, "save(): path"), tensors, header)


def read_calls(path: str | Path) -> dict[str, Any]:
    """Return the fields of a log of calls, from its file.

    Raises:
        RunError: the file is missing, damaged, or holds no log of calls.
    """
    path = as_path(path, "load(): path")
    tensors, header = read_tensors(path, most=None)
    if header.get("kind") != CallsHeader.kind:
        raise RunError(f"{path} holds no log of calls; give a file that CallLog.save() wrote")
    of: CallsHeader = record_in(CallsHeader, header, path)
    try:
        observation, action = map(space_from_json, (of.observation_space, of.action_space))
        _check(of, obs_codec(observation).size)
        columns = _columns(tensors, of, observation, action)
    except (ValueError, SkillweaveError) as error:
        raise RunError(f"{path} is damaged: {error}") from error
    return {
        **fields_of(columns),
        **{name: getattr(of, name) for name in PLAIN},
        "observation_space": observation,
        "action_space": action,
    }


def _check(header: CallsHeader, places: int) -> None:
    """Raise a ValueError where a header contradicts itself, or ``places`` numbers observed."""
    skills, lengths = header.skills, header.lengths
    if not skills or len(set(skills)) != len(skills) or not all(map(NAME.fullmatch, skills)):
        raise ValueError("its skills have no names, or two the same")
    if list(lengths) != sorted(set(lengths)):
        raise ValueError("its lengths do not rise")
    if any(len(getattr(header, name)) != len(skills) for name in PER_SKILL):
        raise ValueError("its header does not have an entry for each skill")
    if header.limits and len(header.limits) != len(skills):
        raise ValueError("its header does not have a limit for each skill")
    if any(place >= places for seen in header.sees for place in seen or ()):
        raise ValueError(f"'sees' has places beyond the {places} of an observation")
    if not set(header.goals) <= set(skills):
        raise ValueError("it has goals of other skills")


def _columns(
    tensors: dict[str, Tensor],
    header: CallsHeader,
    observation: gym.Space[Any],
    action: gym.Space[Any],
) -> dict[str, Array]:
    """Return the columns of a log's file, each of the type, shape and range that it must have."""
    of = {name: tuple(x.shape) for name, x in tensors.items()}
    calls, steps = (math.prod(of.get(name, ())) for name in ("choice", "reward"))
    choices = len(header.skills) * max(1, len(header.lengths))
    acts = obs_dtype(action)
    # Of a goal and a value of `info` the size is free, and the type of numbers that `info` holds.
    sizes = {name: math.prod(of.get(GOAL + name, ())[-1:]) for name in header.goals}
    row = np.dtype(call_fields(observation, choices, sizes))
    per_call = ((name, row[name]) for name in row.names or ())
    table: dict[str, tuple[Any, tuple[int, ...]]] = {
        **{name: (of_row.base, (calls, *of_row.shape)) for name, of_row in per_call},
        "offset": (np.int64, (calls + 1,)),
        "reward": (np.float32, (steps,)),
        "next_obs": (obs_dtype(observation), (steps, *obs_shape(observation))),
        "action": (acts if acts.fields else None, (steps, *obs_shape(action))),
        **{INFO + key: (None, (steps, *of.get(INFO + key, ())[1:])) for key in header.info},
    }
    limits = RANGES | {"choice": (0, choices - 1), "offset": (0, steps)}
    if tensors.keys() != table.keys():
        raise ValueError(f"it has the columns {', '.join(sorted(tensors))}"[:300])
    free = -np.inf, np.inf
    columns = {
        name: _column(name, tensors[name], *one, *limits.get(name, free))
        for name, one in table.items()
    }
    offset = columns["offset"]
    if offset[0] != 0 or offset[-1] != steps or (offset[1:] <= offset[:-1]).any():
        raise ValueError("'offset' is out of range")
    return columns


def _column(
    name: str, tensor: Tensor, dtype: Any, shape: tuple[int, ...], low: float, high: float
) -> Array:
    """Return a column of a log's file; a ValueError says what is wrong.

    Args:
        dtype: None: any numbers. A structured one is read from the bytes of its rows.
    """
    try:
        x = np.ascontiguousarray(tensor.numpy())
    except TypeError:  # NumPy has no such type
        raise ValueError(f"{name!r} is {tensor.dtype}") from None
    fields = None if dtype is None else np.dtype(dtype).names
    wanted = (np.uint8, (shape[0], dtype.itemsize)) if fields else (dtype or x.dtype, shape)
    if (x.dtype, x.shape) != wanted or x.dtype.kind not in "biuf":
        raise ValueError(f"{name!r} is {x.dtype} {x.shape}")
    if fields:
        x = x.view(dtype).reshape(shape[0])
    for numbers in leaves(x):
        if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
            raise ValueError(f"{name!r} is not finite")
        if numbers.size and not (low <= numbers.min() and numbers.max() <= high):
            raise ValueError(f"{name!r} is out of range")
    return x
