"""Files of call logs: safetensors, read with checks, so that a foreign file cannot do harm.

Stands alone because it is a format of files, with its schema.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.collecting.user_code import Texts
from skillweave.errors import RunError, SkillweaveError
from skillweave.messages import as_path
from skillweave.policies.core import CallEnd
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.schema import AtLeastOne, Count, fit
from skillweave.skills.base import NAME
from skillweave.spaces import (
    obs_codec,
    obs_dtype,
    obs_shape,
    space_from_json,
    space_to_json,
    to_tensor,
)
from skillweave.types import LARGEST_REWARD, Array

KIND = "calls"
INFO = "info."
GOAL = "goal."
PLAIN = ("checksums", "recurrent", "own_success")
"""Entries of the header with a value for each skill."""
SPACES = ("observation", "action")


class LoggedRun(TypedDict):
    """The run whose calls a log in its directory holds."""

    id: str | None
    skills: str
    """Checksum of the weights of all its skills."""


class CallsHeader(TypedDict):
    """The JSON header of a log's file."""

    kind: str
    skills: list[str]
    lengths: list[AtLeastOne]
    checksums: list[str]
    sees: list[list[Count] | None]
    recurrent: list[bool]
    own_success: list[bool]
    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    info: list[str]
    goals: NotRequired[list[str]]
    """The skills that have goals."""
    code: NotRequired[Texts]
    run: NotRequired[LoggedRun]


def write_calls(
    path: str | Path,
    columns: Mapping[str, Array],
    about: Mapping[str, Any],
    run: LoggedRun | None = None,
) -> None:
    """Write the columns of a log, and the fields that are no arrays, into a file.

    Args:
        run: the run in whose directory the file is; None: in none.

    Raises:
        RunError: the file cannot be written.
    """
    header = {
        "kind": KIND,
        **{name: list(about[name]) for name in ("skills", "lengths", *PLAIN)},
        "code": about["code"],
        "sees": [None if places is None else list(places) for places in about["sees"]],
        **{f"{what}_space": space_to_json(about[f"{what}_space"]) for what in SPACES},
        "info": [name.removeprefix(INFO) for name in columns if name.startswith(INFO)],
        "goals": [name.removeprefix(GOAL) for name in columns if name.startswith(GOAL)],
    }
    header |= {} if run is None else {"run": run}
    tensors = {name: to_tensor(value) for name, value in columns.items()}
    write_tensors(as_path(path, "save(): path"), tensors, header)


def read_calls(path: str | Path) -> dict[str, Any]:
    """Return the fields of a log in a file.

    Raises:
        RunError: the file is missing, damaged, or holds no log of calls.
    """
    path = as_path(path, "load(): path")
    tensors, header = read_tensors(path)
    if header.get("kind") != KIND:
        raise RunError(f"{path} holds no log of calls; give a file that CallLog.save() wrote")
    fit(CallsHeader, header, str(path))
    try:
        spaces = {f"{what}_space": space_from_json(header[f"{what}_space"]) for what in SPACES}
        return _fields(tensors, header, spaces)
    except (ValueError, SkillweaveError) as error:
        raise RunError(f"{path} is damaged: {error}") from error


def _fields(
    tensors: dict[str, Tensor], header: dict[str, Any], spaces: dict[str, gym.Space[Any]]
) -> dict[str, Any]:
    """Return the checked fields; a ValueError says what is wrong."""
    skills, lengths, info = (tuple(header[k]) for k in ("skills", "lengths", "info"))
    if not skills or len(set(skills)) != len(skills) or not all(map(NAME.fullmatch, skills)):
        raise ValueError("its skills have no names, or two the same")
    if list(lengths) != sorted(set(lengths)):
        raise ValueError("its lengths do not rise")
    if any(len(header[k]) != len(skills) for k in (*PLAIN, "sees")):
        raise ValueError("its header does not have an entry for each skill")
    places = obs_codec(spaces["observation_space"]).size
    if any(place >= places for seen in header["sees"] for place in seen or ()):
        raise ValueError(f"'sees' has places beyond the {places} of an observation")
    goals = tuple(header.get("goals", ()))
    if not set(goals) <= set(skills):
        raise ValueError("it has goals of other skills")
    columns = _columns(tensors, header | {"goals": goals}, spaces)
    offset = columns["offset"]
    if offset[0] != 0 or offset[-1] != len(columns["reward"]) or (offset[1:] <= offset[:-1]).any():
        raise ValueError("'offset' is out of range")
    own = {name: value for name, value in columns.items() if not name.startswith((INFO, GOAL))}
    return (
        own
        | spaces
        | {
            "skills": skills,
            "lengths": lengths,
            **{name: tuple(header[name]) for name in PLAIN},
            "sees": tuple(None if p is None else tuple(p) for p in header["sees"]),
            "info": {key: columns[INFO + key] for key in info},
            "goals": {name: columns[GOAL + name] for name in goals},
            "code": header.get("code", {}),
        }
    )


def _columns(
    tensors: dict[str, Tensor], header: dict[str, Any], spaces: dict[str, gym.Space[Any]]
) -> dict[str, Array]:
    """Return the columns, each of the type, shape and range that it must have."""
    of = {name: tuple(x.shape) for name, x in tensors.items()}
    calls, steps = (math.prod(of.get(name, ())) for name in ("choice", "reward"))
    choices = len(header["skills"]) * max(1, len(header["lengths"]))
    obs, acts = obs_dtype(spaces["observation_space"]), obs_dtype(spaces["action_space"])
    seen, acted = (obs_shape(space) for space in spaces.values())
    free = -np.inf, np.inf
    table: dict[str, tuple[Any, tuple[int, ...], float, float]] = {
        "choice": (np.int64, (calls,), 0, choices - 1),
        "end_reason": (np.int8, (calls,), 1, max(CallEnd)),
        "succeeded": (np.bool_, (calls,), *free),
        "terminated": (np.bool_, (calls,), *free),
        "truncated": (np.bool_, (calls,), *free),
        "episode": (np.int64, (calls,), 0, 2**62 - 1),
        "seed": (np.int64, (calls,), -1, 2**31 - 1),
        "order": (np.int64, (calls,), 0, 2**31 - 1),
        "age": (np.int64, (calls,), 0, 2**31 - 1),
        "may_follow": (np.bool_, (calls, choices), *free),
        "offset": (np.int64, (calls + 1,), 0, steps),
        "reward": (np.float32, (steps,), -LARGEST_REWARD, LARGEST_REWARD),
        "start": (obs, (calls, *seen), *free),
        "next_obs": (obs, (steps, *seen), *free),
        "action": (acts if acts.fields else None, (steps, *acted), *free),
    }
    # Of these the number of columns is free, and the type of numbers that `info` holds.
    table |= {k: (None, (steps, *of.get(k, ())[1:]), *free) for k in _named(INFO, header["info"])}
    table |= {
        k: (np.float64, (calls, *of.get(k, ())[-1:]), *free) for k in _named(GOAL, header["goals"])
    }
    if tensors.keys() != table.keys():
        raise ValueError(f"it has the columns {', '.join(sorted(tensors))}"[:300])
    return {name: _column(name, tensors[name], *row) for name, row in table.items()}


def _named(prefix: str, names: Iterable[str]) -> list[str]:
    return [prefix + name for name in names]


def _column(
    name: str, tensor: Tensor, dtype: Any, shape: tuple[int, ...], low: float, high: float
) -> Array:
    """Return a column; a ValueError says what is wrong.

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
    for numbers in [x[field] for field in fields] if fields else [x]:
        if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
            raise ValueError(f"{name!r} is not finite")
        if numbers.size and not (low <= numbers.min() and numbers.max() <= high):
            raise ValueError(f"{name!r} is out of range")
    return x
