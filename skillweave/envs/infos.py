"""The infos of environments: rows of a batched info, action masks and success in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.errors import EnvError
from skillweave.messages import short
from skillweave.policies.core import OWN_REWARD, SUCCESS
from skillweave.skills.info_words import NUMBERS, info_keys
from skillweave.spaces import (
    action_codec,
    allows_each,
    choice_counts,
    obs_dtype,
    obs_shape,
    put_observation,
)
from skillweave.spaces.packing import parts
from skillweave.types import Array


def batched_infos(infos: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Batch the infos of n environments in the format of Gymnasium's vectors.

    Gymnasium casts the values of all environments to the type of the first, 0.5 to 0 for example.
    Here an array has a type that represents all of them exactly.

    Returns:
        By key, an array over the n environments: of numbers; of arrays of one shape; else of
        objects. Dicts are batched in turn. Where an environment's info lacks the key, the value is
        0, or None among objects, and the (n,) bool under ``_key`` is False.
    """
    if not any(infos):
        return {}
    n = len(infos)
    columns: dict[str, tuple[list[int], list[Any]]] = {}
    for row, info in enumerate(infos):
        for key, value in info.items():
            rows, values = columns.setdefault(key, ([], []))
            rows.append(row)
            values.append(value)
    batch: dict[str, Any] = {}
    for key, (rows, values) in columns.items():
        batch[key] = _column(rows, values, n)
        if (mask := f"_{key}") not in columns:
            present = np.zeros(n, bool)
            present[rows] = True
            batch[mask] = present
    return batch


def _column(rows: list[int], values: list[Any], n: int) -> Any:
    """Return the values of n environments under one key as a column; ``rows`` have one."""
    kinds = set(map(type, values))
    if all(issubclass(kind, dict) for kind in kinds):
        inner: list[dict[str, Any]] = [{}] * n
        for row, value in zip(rows, values, strict=True):
            inner[row] = value
        return batched_infos(inner)
    array = None
    if all(issubclass(kind, NUMBERS) for kind in kinds):
        array = _numbers(values, mixed=len(kinds) > 1 or int in kinds)
    elif all(issubclass(kind, np.ndarray) for kind in kinds):
        array = _stacked(values)
    if array is not None:
        if len(rows) == n:
            return array
        column = np.zeros((n, *array.shape[1:]), array.dtype)
        column[rows] = array
        return column
    objects = np.full(n, None, object)
    for row, value in zip(rows, values, strict=True):
        objects[row] = value
    return objects


def _numbers(values: list[Any], *, mixed: bool) -> Array | None:
    """Return numbers as an array; None: no type represents all of them exactly."""
    array = np.array(values)
    if array.dtype.kind not in "biufc":
        return None  # whole numbers that are too large
    if mixed and array.dtype.kind == "f":
        same = (a == v or v != v for a, v in zip(array.tolist(), values, strict=True))
        return array if all(same) else None
    return array


def _stacked(values: list[Array]) -> Array | None:
    """Stack arrays; None: no array represents all of them exactly."""
    first = values[0]
    if any(v.shape != first.shape for v in values):
        return None
    try:
        stacked = np.stack(values)
    except TypeError:  # dates and numbers, for example
        return None
    if any(v.dtype != stacked.dtype for v in values):
        same = all(
            np.array_equal(a, v, equal_nan=v.dtype.kind == "f")
            for a, v in zip(stacked, values, strict=True)
        )
        return stacked if same else None
    return stacked


def joined_infos(infos: Sequence[Mapping[str, Any]], counts: Sequence[int]) -> dict[str, Any]:
    """Join the batched infos of several groups, of ``counts`` environments each."""
    first = infos[0]
    plain = all(isinstance(v, np.ndarray) and v.ndim and v.dtype != object for v in first.values())
    if plain and all(_alike(info, first) for info in infos):
        return {key: np.concatenate([info[key] for info in infos]) for key in first}
    return batched_infos(
        [one for info, n in zip(infos, counts, strict=True) for one in _single(info, n)]
    )


def _alike(info: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two batched infos have the same keys, with arrays of one type and shape."""
    return info.keys() == other.keys() and all(
        isinstance(value := info[key], np.ndarray)
        and value.dtype == like.dtype
        and value.shape[1:] == like.shape[1:]
        for key, like in other.items()
    )


def _single(info: Mapping[str, Any], n: int) -> list[dict[str, Any]]:
    """Return the info of each of n environments: the inverse of ``batched_infos``."""
    each: list[dict[str, Any]] = [{} for _ in range(n)]
    for key in info_keys(info):
        column = info[key]
        values = _single(column, n) if isinstance(column, dict) else column
        present = info.get(f"_{key}", np.ones(n, bool))
        for row in np.flatnonzero(present):
            each[row][key] = values[row]
    return each


MASK = "action_mask"
"""The key of masks in infos and observations."""


def observes_mask(observation_space: gym.Space[Any], space: gym.Space[Any]) -> bool:
    """Return whether observations have a part that is the action mask."""
    if not isinstance(observation_space, gym.spaces.Dict) or MASK not in observation_space.spaces:
        return False
    size = sum(choice_counts(space))
    return bool(size) and int(np.prod(observation_space.spaces[MASK].shape or ())) == size


def checked_mask(value: Any, space: gym.Space[Any]) -> Array:
    """Return a mask of an environment or a user for the choices of a space as (A,) bool.

    Several choices may have a list each. The mask of a Dict or Tuple is a dict or tuple of masks,
    and where a part has none, all is allowed. It may also be one array.

    Raises:
        ValueError: the value does not have a number for each choice; the message shows it.
    """
    return _checked_mask(value, space, "its action_mask")


def _checked_mask(value: Any, space: gym.Space[Any], what: str) -> Array:
    """Return a mask as (A,) bool; ``what`` begins messages."""
    named = parts(space)
    by_place = isinstance(space, gym.spaces.Tuple) and _is_by_place(value)
    if named is not None and (by_place or isinstance(value, Mapping)):
        if by_place and len(value) != len(named):
            raise ValueError(
                f"{what} has {len(value)} parts, but actions of {short(space)} have {len(named)}"
            )
        given = dict(zip(named, value, strict=True)) if by_place else value
        if not set(given) <= set(named):
            raise ValueError(
                f"{what} has the parts {short(list(given))}, but actions of {short(space)} have "
                f"{', '.join(map(repr, named))}"
            )
        masks = [
            _checked_mask(given[name], part, f"{what}[{name!r}]")
            if given.get(name) is not None and choice_counts(part)
            else np.ones(sum(choice_counts(part)), bool)
            for name, part in named.items()
        ]
        return np.concatenate(masks)
    size = sum(choice_counts(space))
    mask = _flat(value)
    if mask.size != size or mask.dtype.kind not in "iubf":
        raise ValueError(
            f"{what} is {short(value)}; it must be a number for each choice of {space}, "
            f"{size} in all, 0 where it is forbidden"
        )
    allowed: Array = mask.reshape(-1) != 0
    return allowed


def _is_by_place(value: Any) -> bool:
    """Return whether the mask of a Tuple is a list of masks, and not one of numbers."""
    if not isinstance(value, tuple | list):
        return False
    return not all(isinstance(each, int | float | np.number | np.bool_) for each in value)


def _flat(value: Any) -> Array:
    """Return a mask as an array; of lists of unequal lengths their numbers, one after another."""
    try:
        mask = np.asarray(value)
    except ValueError:
        mask = np.array(None)
    if mask.dtype == object:
        with suppress(TypeError, ValueError):
            mask = np.concatenate([np.ravel(part) for part in value])
    return mask


class ActionMasks:
    """The actions that N environments allow now, from their infos or observations.

    Gymnasium's convention: ``info["action_mask"]`` of ``reset`` and ``step`` has a number for each
    choice, 0 where it is forbidden. For several choices at once (MultiDiscrete, MultiBinary) the
    numbers follow choice by choice. ``CheckedEnv`` has added the mask of ``action_masks()``. Else a
    Dict's part ``action_mask`` is the mask, as in PettingZoo and RLlib. Without any, all actions
    are allowed. Real numbers are no choices, so masks leave them out.

    Args:
        space: the action space.
        observation_space: the space of observations, which may have a mask.
    """

    def __init__(
        self,
        space: gym.Space[Any],
        num_envs: int,
        now: Array | None = None,
        observation_space: gym.Space[Any] | None = None,
    ) -> None:
        self._space = space
        self._num_envs = num_envs
        self._observed = observation_space is not None and observes_mask(observation_space, space)
        self._choices = choice_counts(space)
        self.now = now
        """(N, A) bool; None: no environment has returned a mask so far. Never changed in place."""

    def see(
        self,
        info: Mapping[str, Any],
        ids: Array | None = None,
        ended: Array | None = None,
        obs: Array | None = None,
    ) -> None:
        """Update the masks of environments ``ids`` (n,), rows in their order; None: of all.

        Args:
            ended: (n,) bool, where the episode is over: no action needs to be allowed there.
            obs: (n, *obs_shape), their observations.

        Raises:
            EnvError: a mask has another shape, or allows nothing; the message names the
                environment.
        """
        value = info.get("action_mask")
        if value is None and self._observed and obs is not None:
            value = obs[MASK].reshape(len(obs), -1)
        if not self._choices or (value is None and self.now is None):
            return
        ids = np.arange(self._num_envs) if ids is None else ids
        size = sum(self._choices)
        mask = np.ones((len(ids), size), bool)
        if value is not None:
            present = np.asarray(info.get("_action_mask", np.ones(len(ids), bool)))
            mask[present] = self._checked(value, (len(ids), size))[present]
        free = allows_each(mask, self._choices)
        over = np.zeros(len(ids), bool) if ended is None else ended
        if not (free | over).all():
            raise EnvError(
                f"environment {ids[np.flatnonzero(~free & ~over)[0]]} allows no action, though its "
                "episode continues: its action_mask is 0 for all values of a choice; allow at "
                "least one"
            )
        mask[~free] = True
        now = np.ones((self._num_envs, size), bool) if self.now is None else self.now.copy()
        now[ids] = mask
        self.now = now

    def _checked(self, value: Any, shape: tuple[int, int]) -> Array:
        mask = np.asarray(value)
        if mask.shape != shape or mask.dtype.kind not in "iubf":
            raise EnvError(
                f"the action_mask of the environments is of {mask.dtype} and shape "
                f"{mask.shape}, but numbers of shape {shape} were expected: one for each choice of "
                f"{self._space}, 0 where it is forbidden"
            )
        allowed: Array = mask != 0
        return allowed


IS_SUCCESS = "is_success"
"""The key of success in Stable-Baselines3 and Gymnasium-Robotics."""


def reported_success(info: Mapping[str, Any], n: int) -> Array | None:
    """Return the success of n environments' episodes by ``info["success"]``.

    Where that is missing, ``info["is_success"]`` counts.

    Returns:
        (n,) float64, NaN where an environment reports none; None: no environment reports any.
    """
    success = _success(info, SUCCESS, n)
    if OWN_REWARD in info:  # the success of the environment is not the task's
        return success
    other = _success(info, IS_SUCCESS, n)
    if success is None or other is None:
        return other if success is None else success
    return np.where(np.isnan(success), other, success)


def _success(info: Mapping[str, Any], key: str, n: int) -> Array | None:
    success = np.asarray(info.get(key))
    if success.shape == (n,) and success.dtype == object:  # for example None until it is known
        known = [isinstance(value, NUMBERS) for value in success]
        if not any(known):
            return None
        values = [v != 0 if k else np.nan for v, k in zip(success, known, strict=True)]
        return np.array(values, float)
    if success.shape != (n,) or success.dtype.kind not in "biuf":
        return None
    present = np.asarray(info.get(f"_{key}", np.ones(n, bool)))
    return np.where(present, success != 0, np.nan)


def info_numbers(info: Mapping[str, Any], key: str, ids: Array, n: int) -> Array | None:
    """Return the numbers under a key in the infos of environments ``ids`` (k,), of n.

    Returns:
        (k,) float64, NaN where an environment has no finite number; None: no environment has one.

    Raises:
        EnvError: a value is not a number; the message names its type.
    """
    if key == SUCCESS and key not in info and OWN_REWARD not in info:
        key = IS_SUCCESS
    if key not in info:
        return None
    values = info[key]
    present = np.asarray(info.get(f"_{key}", np.ones(n, bool)))[ids]
    if not present.any():
        return None
    if not isinstance(values, np.ndarray) or values.shape[:1] != (n,):
        raise _no_number(key, f"of type {type(values).__name__}")
    if values.size > n:
        raise _no_number(key, f"an array of shape {values.shape[1:]}")
    numbers = np.full(len(ids), np.nan)
    for row in np.flatnonzero(present):
        value = values.reshape(n)[ids[row]]
        if value is None:
            continue
        if not isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating):
            raise _no_number(key, f"of type {type(value).__name__}")
        numbers[row] = value
    numbers[~np.isfinite(numbers)] = np.nan
    return numbers


def _no_number(key: str, what: str) -> EnvError:
    return EnvError(
        f"log_info names {short(key)}, but info[{short(key)}] is {what} at the end of an episode; "
        "let the environment set a number there, or remove the key from log_info"
    )


def allowed_rows(mask: Array | None, rows: Array) -> Array | None:
    """Return rows of an action mask; None stays None."""
    return None if mask is None else mask[rows]


def random_actions(
    space: gym.Space[Any], n: int, rng: np.random.Generator, mask: Array | None = None
) -> Array:
    """Draw n actions at random from a space, among those that ``mask`` (n, A) allows."""
    space.seed(int(rng.integers(2**31)))
    drawn = np.zeros((n, *obs_shape(space)), obs_dtype(space))
    for row in range(n):
        put_observation(space, drawn, row, space.sample())
    if mask is None:
        return drawn
    return action_codec(space).allowed_at_random(drawn, mask, rng)
