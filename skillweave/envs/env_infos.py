"""The infos of environments: rows of a batched info, action masks and success in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave.errors import EnvError
from skillweave.policies.core import OWN_REWARD, SUCCESS, Array
from skillweave.policies.infos import Infos, batched_infos, one_number
from skillweave.policies.spaces import allows_each
from skillweave.skills.outputs import info_keys
from skillweave.spaces import (
    action_codec,
    choice_counts,
    obs_dtype,
    obs_shape,
    put_observation,
)


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
        """Return an action mask from an environment's info as bool; check its shape."""
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


TIME_LIMITS = ("TimeLimit.truncated", "time_outs")
"""Keys that are true where an end is a time limit: of old Gym and Stable-Baselines3, and of
simulators of robots (Isaac, rsl_rl)."""


def time_limits(info: Mapping[str, Any], n: int) -> Array:
    """Return where the infos of n environments say that an end is a time limit, (n,) bool."""
    found = np.zeros(n, bool)
    for key in TIME_LIMITS:
        if key in info:
            found |= _column(info, key, n)[0] == 1
    return found


def reported_success(info: Mapping[str, Any], n: int) -> Array | None:
    """Return the success of n environments' episodes by ``info["success"]``.

    Where that is missing, ``info["is_success"]`` counts.

    Returns:
        (n,) float64: 1 or 0; 0 where an environment gives no such key; NaN where it gives None, or
        no number. None: no environment has given such a key so far.
    """
    # The success of a task's environment is not the task's.
    names = (SUCCESS,) if OWN_REWARD in info else (SUCCESS, IS_SUCCESS)
    so_far = info.keys_so_far.examples if isinstance(info, Infos) else {}
    if not any(name in info or name in so_far for name in names):
        return None
    success = np.zeros(n)
    given = np.zeros(n, bool)
    for name in reversed(names):
        if name in info:
            values, present, _ = _column(info, name, n)
            known = ~np.isnan(values)
            success[present & ~known & ~given] = np.nan
            success[known] = values[known] != 0
            given |= known
    return success


def notice_odd_success(info: Mapping[str, Any], n: int) -> None:
    """Give a notice where one of n environments gives a success that is not understood."""
    for key in (SUCCESS, IS_SUCCESS):
        if key in info and (odd := _column(info, key, n)[2]):
            notice(
                f"info[{key!r}] is {odd}, so it does not count as the success of an episode: let "
                "the environment set True or False there"
            )
            return


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
    values, present, odd = _column(info, key, n, ids)
    if not present.any():
        return None
    if odd is not None:
        raise _no_number(key, odd)
    values[~np.isfinite(values)] = np.nan
    return values


def _column(
    info: Mapping[str, Any], key: str, n: int, ids: Array | None = None
) -> tuple[Array, Array, str | None]:
    """Return the only number of each environment under a key, in any wrapping.

    Args:
        n: the number of environments in the info.
        ids: (k,) some of them; None: all.

    Returns:
        (k,) float64, NaN where it is not known, or no number; (k,) bool, where an environment gives
        the key; and in words the first value that is no number, None if all are.
    """
    ids = np.arange(n) if ids is None else ids
    present = np.broadcast_to(np.asarray(info.get(f"_{key}", True), bool), n)[ids]
    column = info[key]
    batched = isinstance(column, np.ndarray) and column.shape[:1] == (n,)
    if batched and column.size == n and column.dtype.kind in "biuf":
        return np.where(present, column.reshape(n)[ids], np.nan).astype(float), present, None
    numbers = np.full(len(ids), np.nan)
    odd = None
    for row in np.flatnonzero(present):
        value = column[ids[row]] if batched else column
        number = one_number(value)
        if number is not None:
            numbers[row] = number
        elif odd is None:
            shape = np.shape(value) if isinstance(value, np.ndarray) else ()
            name = "dict" if isinstance(value, dict) else type(value).__name__
            odd = f"an array of shape {shape}" if shape else f"of type {name}"
    return numbers, present, odd


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
