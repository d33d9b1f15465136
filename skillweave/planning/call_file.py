"""Files of call logs: safetensors, read with checks, so that a foreign file cannot do harm.

Stands alone because it is a format of files, with its schema.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.collecting.call_end import CallEnd
from skillweave.errors import RunError, SkillweaveError
from skillweave.messages import as_path
from skillweave.reading import fit
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.settings import AtLeastOne, Count
from skillweave.skills.base import NAME
from skillweave.spaces import (
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
TYPES = {
    "choice": np.int64,
    "end_reason": np.int8,
    "succeeded": np.bool_,
    "terminated": np.bool_,
    "truncated": np.bool_,
    "episode": np.int64,
    "seed": np.int64,
    "order": np.int64,
    "age": np.int64,
    "may_follow": np.bool_,
    "offset": np.int64,
    "reward": np.float32,
}
"""Types of all columns but observations and actions."""


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
    columns = {name: value.numpy() for name, value in tensors.items()}
    goals = tuple(header.get("goals", ()))
    if not set(goals) <= set(skills):
        raise ValueError("it has goals of other skills")
    expected = {*TYPES, "start", "next_obs", "action", *(INFO + key for key in info)}
    expected |= {GOAL + name for name in goals}
    if columns.keys() != expected:
        raise ValueError(f"it has the columns {', '.join(sorted(columns))}"[:300])
    calls, steps = len(columns["choice"].reshape(-1)), len(columns["reward"].reshape(-1))
    choices = len(skills) * max(1, len(lengths))
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(TYPES, (calls,))
    shapes |= {"may_follow": (calls, choices), "offset": (calls + 1,), "reward": (steps,)}
    for name, kind in TYPES.items():
        _check(name, columns[name], shapes[name], np.dtype(kind))
    for name, rows in (("start", calls), ("next_obs", steps)):
        columns[name] = _packed(name, columns[name], spaces["observation_space"], rows)
    acts = spaces["action_space"]
    if obs_dtype(acts).fields is None:
        _check("action", columns["action"], (steps, *(acts.shape or ())), None)
    else:
        columns["action"] = _packed("action", columns["action"], acts, steps)
    for key in info:
        _check(INFO + key, columns[INFO + key], (steps, *columns[INFO + key].shape[1:]), None)
    for name in goals:
        column = columns[GOAL + name]
        _check(GOAL + name, column, (calls, *column.shape[1:2]), np.dtype(np.float64))
    _check_values(columns, steps, choices)
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
        }
    )


def _check(name: str, x: Array, shape: tuple[int, ...], dtype: Any) -> None:
    """Check a column's shape and type, and that its numbers are finite."""
    if x.shape != shape or (dtype is not None and x.dtype != dtype):
        raise ValueError(f"{name!r} is {x.dtype} {x.shape}")
    if x.dtype.kind == "f" and not np.isfinite(x).all():
        raise ValueError(f"{name!r} is not finite")


def _packed(name: str, x: Array, space: gym.Space[Any], rows: int) -> Array:
    """Return observations or actions as they were, structured ones from their bytes."""
    dtype = obs_dtype(space)
    if dtype.fields is None:
        _check(name, x, (rows, *obs_shape(space)), dtype)
        return x
    _check(name, x, (rows, dtype.itemsize), np.dtype(np.uint8))
    structured: Array = np.ascontiguousarray(x).view(dtype).reshape(rows)
    for part in dtype.names or ():
        numbers = structured[part]
        if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
            raise ValueError(f"{name!r} is not finite")
    return structured


def _check_values(columns: dict[str, Array], steps: int, choices: int) -> None:
    """Check that numbers are in their ranges, and that columns agree."""
    offset, choice = columns["offset"], columns["choice"]
    in_range = {
        "offset": offset[0] == 0 and offset[-1] == steps and bool((np.diff(offset) >= 1).all()),
        "choice": bool(((choice >= 0) & (choice < choices)).all()),
        "end_reason": bool(np.isin(columns["end_reason"], list(CallEnd)[1:]).all()),
        "order": bool((columns["order"] >= 0).all()),
        "age": bool(((columns["age"] >= 0) & (columns["age"] < 2**31)).all()),
        "episode": bool(((columns["episode"] >= 0) & (columns["episode"] < 2**62)).all()),
        "seed": bool(((columns["seed"] >= -1) & (columns["seed"] < 2**31)).all()),
        "reward": bool((np.abs(columns["reward"]) <= LARGEST_REWARD).all()),
    }
    if wrong := [name for name, right in in_range.items() if not right]:
        raise ValueError(f"{wrong[0]!r} is out of range")
