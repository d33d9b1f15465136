"""Checked results of the user's functions of steps and observations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from skillweave.errors import SkillError
from skillweave.messages import short
from skillweave.policies.infos import NUMBERS
from skillweave.skills.info_words import odd_key
from skillweave.skills.outputs import as_array, at_step, called
from skillweave.skills.probing import probe
from skillweave.types import LARGEST_REWARD, Array, Step, read_only, wrong_reward


def answer(
    function: Callable[[Any], Any],
    about: Step | Array,
    n: int,
    dtype: type,
    who: str,
    method: str,
    elapsed: Array | int | None = None,
    ids: Array | None = None,
    *,
    may_change: bool = False,
) -> Array:
    """Call a function of the user and return its ``checked`` result.

    Args:
        may_change: its answer to the same may change from call to call.

    Raises:
        SkillError: the function failed, or returned a result of a wrong shape or type.
    """
    if isinstance(about, np.ndarray):
        about = read_only(about)
    judges = None if may_change else True
    value = called(function, about, f"{who}: {method}()", elapsed, ids, judges=judges)
    objects = isinstance(value, np.ndarray) and value.dtype == object
    if objects and isinstance(about, Step) and (odd := odd_key(function, about.info, ids)):
        raise SkillError(f"{who}: {method}(){at_step(elapsed)}: {odd}")
    array = checked(value, n, dtype, who, method, elapsed, ids)
    probe(function, about, n, f"{who}: {method}()")
    return array


def ask(function: Callable[[Any], Any], about: Any, rows: Array, path: str, name: str) -> Array:
    """Ask a function of a user; see ``policies.core.Asks`` and ``answer``."""
    elapsed = getattr(about, "elapsed", None)
    who = f"skill {path!r}"
    return answer(function, about, len(rows), bool, who, name, elapsed, rows)


def checked(
    value: Any,
    n: int,
    dtype: type,
    who: str,
    method: str,
    elapsed: Array | int | None = None,
    ids: Array | None = None,
) -> Array:
    """Convert ``value`` to an array (n,) of ``dtype``.

    Args:
        elapsed: steps of the rows, (n,) or (), for messages.
        ids: environments of the rows, (n,), for messages; None: all n.

    Raises:
        SkillError: the value has another shape or type, or a NaN or an infinity; the message
            names the skill, the method and the step.
    """
    if value is None:
        raise SkillError(
            f"{who}: {method}() returned None{at_step(elapsed)}, but shape ({n},) was expected: "
            "does it lack a return?"
        )
    array = as_array(value, f"{who}: {method}()")
    if array.shape != (n,):
        one = "yes or no" if dtype is bool else "number"
        raise SkillError(
            f"{who}: {method}() returned shape {array.shape}{at_step(elapsed)}, but ({n},) was "
            f"expected: one {one} for each of the {n} environments, the first axis of every array"
        )
    if dtype is bool:
        return (
            array
            if array.dtype == bool
            else _flags(array, f"{who}: {method}()", at_step(elapsed), ids)
        )
    if array.dtype == object and all(isinstance(value, NUMBERS) for value in array):
        array = array.astype(np.float64)
    if array.dtype.kind not in "fiub":
        raise SkillError(
            f"{who}: {method}() returned {_kind(array)}{at_step(elapsed)}, but rewards are real "
            "numbers"
        )
    with np.errstate(over="ignore"):  # an overflow is an infinity, reported below
        array = array.astype(dtype, copy=False)
    if (row := wrong_reward(array)) is not None:
        when = "" if elapsed is None else f" at step {np.broadcast_to(elapsed, n)[row]}"
        raise SkillError(
            f"{who}: {method}() returned {array[row]}{when} for environment {_number(row, ids)}: "
            f"rewards must be finite, and at most {LARGEST_REWARD:g} in size"
        )
    return array


def _number(row: int, ids: Array | None) -> int:
    """Return the environment of a row."""
    return row if ids is None else int(ids[row])


def _flags(array: Array, what: str, when: str, ids: Array | None) -> Array:
    """Convert numbers that are all 0 or 1 to bool."""
    if array.dtype.kind not in "fiu":
        raise SkillError(f"{what} returned {_kind(array)}{when}, but yes or no (bool) is needed")
    wrong = np.flatnonzero((array != 0) & (array != 1))
    if len(wrong):
        row = int(wrong[0])
        raise SkillError(
            f"{what} returned {array[row]}{when} for environment {_number(row, ids)}, but yes or "
            "no (bool) is needed: return a comparison"
        )
    return array.astype(bool)


def _kind(array: Array) -> str:
    first = array.reshape(-1)[:1].tolist()  # Python's numbers, which are easier to read
    return f"{array.dtype} ({short(first[0])})" if first else str(array.dtype)
