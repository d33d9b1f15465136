"""The infos of environments: rows of a batched info, action masks and success in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave.errors import EnvError
from skillweave.policies.core import OWN_REWARD, SUCCESS
from skillweave.policies.infos import NUMBERS, batched_infos
from skillweave.policies.spaces import allows_each
from skillweave.skills.outputs import info_keys
from skillweave.spaces import (
    action_codec,
    choice_counts,
    obs_dtype,
    obs_shape,
    put_observation,
)
from skillweave.types import Array


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
        observation_space: gym.Space[Any] | None = None,
    ) -> None:
        self._space = space
        self._num_envs = num_envs
        self._observed = observation_space is not None and observes_mask(observation_space, space)
        self._choices = choice_counts(space)
        self.now: Array | None = None
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
    """Return the action masks of some environments; None: they give none."""
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
