"""Calls of the user's functions, and checks of what they return."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, NoReturn, cast

import numpy as np

from skillweave._internal.messages import error_text, short, suggest
from skillweave._internal.rewards import LARGEST_REWARD, wrong_reward
from skillweave._internal.tracebacks import is_users
from skillweave.errors import PolicyError, SkillError, SkillweaveError
from skillweave.policies.core import Array, InCall, Step, read_only
from skillweave.policies.floats import by_program
from skillweave.policies.infos import NUMBERS, Infos
from skillweave.skills.probing import look_at
from skillweave.skills.rows import Call

OF_DICTS = ("no field of name", "dtype([", "VoidDType", "numpy.void")
"""Parts of errors of NumPy about an array of a Dict or Tuple, which is not a plain array."""


def call_user(
    function: Any,
    argument: Any,
    who: str,
    ids: Array | None = None,
    kind: type[SkillweaveError] = SkillError,
    more: tuple[Any, ...] = (),
    named: Mapping[str, Any] | None = None,
    fixed: tuple[Any, ...] = (),
    judges: bool | None = False,
    looks: bool = True,
    convert: Callable[[Any], Any] = lambda value: value,
) -> Any:
    """Return the result of a function of the user; all of them are called here.

    Args:
        function: takes one argument, ``more``, ``fixed`` and ``named``.
        argument: a step, or observations; None: all are named.
        who: the function's name in messages.
        ids: the environments of the rows.
        kind: the type of the error: PolicyError if the function is a policy.
        more: further arguments, with a row for each environment.
        named: arguments by name, with a row for each environment.
        fixed: further arguments, the same for all environments.
        judges: its answer to the same must never change; None: it may keep a state.
        looks: it may be called again with other rows.
        convert: checks and converts the result.

    Raises:
        SkillError: the function raised; the message names ``who``, the line, and the step if known.
            Or its answer about an environment depends on something else, see ``probing``.
    """
    call = Call(function, () if argument is None else (argument, *more), named or {}, fixed)
    look = look_at(call, judges) if looks else None
    try:
        value = by_program(call)
    except SkillweaveError:
        raise
    except (Exception, SystemExit) as error:
        about = getattr(argument, "shape", None)
        when = at_step(getattr(argument, "elapsed", None))
        given = "" if about is None else f" for observations of shape {about}"
        advice = _advice(error, function, argument, ids)
        raise kind(f"{who} raised {error_text(error)}{when}{given}{advice}") from error
    converted = convert(value)
    if look is not None:
        look.check(value, who, kind)
    return converted


@dataclass(frozen=True)
class Wrapped:
    """A function of the user, ``bare``, called with this library's messages.

    Exports name it.
    """

    bare: Callable[..., Any]
    call: Callable[..., Any]

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Return the answer of the function."""
        return self.call(*arguments, **named)


def of_numbers(function: Any, who: str) -> Wrapped:
    """Return a function of the user, observations to numbers, called by ``call_user``."""
    return Wrapped(function, partial(_numbers, function, who))


def _numbers(function: Any, who: str, obs: Array, call: InCall | None = None) -> Array:
    convert = partial(as_array, who=who, kind=PolicyError)
    named = {} if call is None else {"call": call}
    return cast(
        Array, call_user(function, obs, who, kind=PolicyError, named=named, convert=convert)
    )


def call_checked(
    function: Callable[[Any], Any],
    about: Step | Array,
    dtype: type,
    who: str,
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
    elapsed = None
    if isinstance(about, Step):
        n = len(about.reward)
        elapsed = about.elapsed
    else:
        n, about = len(about), read_only(about)

    def convert(value: Any) -> Array:
        objects = isinstance(value, np.ndarray) and value.dtype == object
        if objects and isinstance(about, Step) and (odd := odd_key(function, about.info, ids)):
            raise SkillError(f"{who}{at_step(elapsed)}: {odd}")
        return checked(value, n, dtype, who, elapsed, ids)

    judges = None if may_change else True
    return cast(Array, call_user(function, about, who, ids, judges=judges, convert=convert))


def call_skill(
    function: Callable[[Any], Any], about: Any, rows: Array, path: str, name: str
) -> Array:
    """Call a method of a skill that acts; a ``policies.core.CallUser``, see ``call_checked``."""
    return call_checked(function, about, bool, f"skill {path!r}: {name}()", rows)


def checked(
    value: Any,
    n: int,
    dtype: type,
    who: str,
    elapsed: Array | int | None = None,
    ids: Array | None = None,
) -> Array:
    """Convert a user's answer to an array (n,) of ``dtype``: bool, or the type of rewards.

    Args:
        elapsed: steps of the rows, (n,) or (), for messages.
        ids: environments of the rows, (n,), for messages; None: all n.

    Raises:
        SkillError: the value has another shape or type, or a NaN or an infinity; the message
            names the function ``who`` and the step.
    """
    flags = dtype is bool
    when = at_step(elapsed)
    if value is None:
        raise SkillError(
            f"{who} returned None{when}, but shape ({n},) was expected: does it lack a return?"
        )
    array = as_array(value, who)
    if array.shape != (n,):
        raise SkillError(
            f"{who} returned shape {array.shape}{when}, but ({n},) was expected: one "
            f"{'yes or no' if flags else 'number'} for each of the {n} environments, the first "
            "axis of every array"
        )
    if flags and array.dtype == bool:
        return array
    if not flags and array.dtype == object and all(isinstance(x, NUMBERS) for x in array):
        array = array.astype(np.float64)
    needed = "yes or no (bool) is needed" if flags else "rewards are real numbers"
    if array.dtype.kind not in "fiub":
        first = array[:1].tolist()  # Python's numbers, which are easier to read
        kind = f"{array.dtype} ({short(first[0])})" if first else array.dtype
        raise SkillError(f"{who} returned {kind}{when}, but {needed}")
    if flags:
        row: Any = next(iter(np.flatnonzero((array != 0) & (array != 1))), None)
        needed = f", but {needed}: return a comparison"
    else:
        with np.errstate(over="ignore"):  # an overflow is an infinity
            array = array.astype(dtype, copy=False)
        row = wrong_reward(array)
        needed = f": rewards must be finite, and at most {LARGEST_REWARD:g} in size"
    if row is not None:
        when = "" if elapsed is None else at_step(np.broadcast_to(elapsed, n)[row])
        place = row if ids is None else ids[row]
        raise SkillError(f"{who} returned {array[row]}{when} for environment {place}{needed}")
    return array.astype(dtype, copy=False)


def parameters_of(function: Any) -> list[inspect.Parameter]:
    """Return the parameters of a user's function; none if Python has no signature of it."""
    try:
        return list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # of some functions written in C
        return []


def required_arguments(function: Any) -> int:
    """Return the number of required arguments of a user's function, as far as known."""
    return sum(
        p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty
        for p in parameters_of(function)
    )


def _advice(error: BaseException, function: Any, argument: Any, ids: Array | None) -> str:
    """Return advice on a mistake of a user's function, if it is a common one; else ""."""
    text = str(error)
    step = isinstance(argument, Step)
    obs = argument.next_obs if step else argument
    keys = getattr(getattr(obs, "dtype", None), "names", None)
    example = f"{'step.next_obs' if step else 'obs'}[{repr(keys[0]) if keys else ':, 0'}]"
    name = getattr(error, "name", None) if isinstance(error, AttributeError) else None
    key = error.args[0] if isinstance(error, KeyError) and error.args else None
    if step and isinstance(key, str) and key not in argument.info:
        return f"; {missing_key(argument.info)}"
    if (
        step
        and isinstance(error, TypeError | ValueError)
        and (odd := odd_key(function, argument.info, ids))
    ):
        return f"; {odd}"
    if step and argument.goal is None and "NoneType" in text:
        return (
            "; if it reads step.goal: that is None here, as only methods of a skill with a "
            "goal_space get goals. The predicates and rewards of a task, and success as a word of "
            "a mission, know no goal: write the predicate without it"
        )
    if "read-only" in text:
        return "; its argument is read-only: change a copy"
    if "truth value of an array" in text:
        return "; combine arrays by & and |, with each side in parentheses; use np.where for if"
    frames = error.__traceback__
    entered = frames is None or frames.tb_next is not None  # else none of its lines ran
    if "positional argument" in text and "given" in text and not entered:
        what = "(self, step)" if step else "(self, obs)"
        return f"; a method of a skill takes {what}, another function only the last of these"
    if step and ("not subscriptable" in text or name in dir(np.ndarray)):
        return f"; its argument is a Step: write {example}"
    if step and name is not None and getattr(error, "obj", None) is argument:
        return suggest(name, [f.name for f in fields(Step)])
    if isinstance(argument, np.ndarray) and name in Step.__slots__:
        return f"; its argument is observations, not a Step: write {example}"
    if keys and (
        isinstance(error, IndexError)
        or isinstance(getattr(error, "obj", None), np.ndarray)
        or any(part in text for part in OF_DICTS)
    ):
        kind = "Tuple" if keys[0] == "0" else "Dict"
        names = ", ".join(map(repr, keys))
        wrong = text.partition("no field of name ")[2].strip("'\"")
        meant = suggest(wrong, keys, listed=False) if wrong else ""
        return f"; the observation is a {kind} with the keys {names}{meant or f': write {example}'}"
    if isinstance(error, IndexError) and step:
        return f"; step.next_obs has the shape {argument.next_obs.shape}"
    return ""


def blame(error: BaseException, who: str) -> NoReturn:
    """Raise a PolicyError that names ``who`` where the user's function raised ``error``.

    Otherwise raise ``error`` itself: its traceback shows a bug of this library.
    """
    if isinstance(error, SkillweaveError) or not is_users(error):
        raise error
    raise PolicyError(f"{who} raised {error_text(error)}") from error


def at_step(elapsed: Any) -> str:
    """Return the step, for messages; an empty string if ``elapsed`` is None."""
    return "" if elapsed is None else f" at step {np.max(elapsed)}"


def as_array(value: Any, who: str, kind: type[SkillweaveError] = SkillError) -> Array:
    """Return ``value``, the answer of a user's function, as an array.

    Raises:
        SkillError: it cannot be converted; the message names ``who``. ``kind`` is the type of the
            error.
    """
    try:
        return np.asarray(value)
    except Exception as error:
        raise kind(
            f"{who} returned {short(value)}, which is no array: {error_text(error)}"
        ) from error


# Words about infos


def info_keys(info: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys of a batched info that are text, without Gymnasium's masks (``_key``)."""
    texts = (key for key in info if isinstance(key, str))
    return tuple(key for key in texts if not (key.startswith("_") and key[1:] in info))


def missing_key(info: Mapping[str, Any]) -> str:
    """Return a clause on a key of info that a user's function reads, and none sets."""
    far = isinstance(info, Infos)
    keys = keys_of(info.keys_so_far.examples if isinstance(info, Infos) else info)
    return (
        f"no environment set this key of info {'so far' if far else 'in this step'} (the keys are: "
        f"{keys}): let the environment set it in each step"
    )


def keys_of(info: Mapping[str, Any]) -> str:
    """Return the keys of a batched info, in words."""
    return ", ".join(short(key) for key in info_keys(info)) or "nothing"


def odd_key(function: Any, info: Mapping[str, Any], ids: Array | None = None) -> str:
    """Return a clause on a key that a function reads and that is not a number everywhere.

    Args:
        function: the user's function; it reads a key if the key is among its constants.
        ids: (n,) the environments; None: all n.

    Returns:
        An empty string if all its keys are numbers.
    """
    code = getattr(getattr(function, "__func__", function), "__code__", None)
    for key in getattr(code, "co_consts", ()):
        column = info.get(key) if isinstance(key, str) else None
        if isinstance(column, dict):
            return f"info[{key!r}] is a dict of {keys_of(column)}: read one of these"
        if not isinstance(column, np.ndarray) or column.dtype != object or column.ndim != 1:
            continue
        number = [isinstance(value, NUMBERS) for value in column]
        if all(number):
            continue
        rows = [number.index(True)] if any(number) else []
        rows.append(number.index(False))
        values = (
            f"{short(column[row])} of environment {row if ids is None else int(ids[row])}"
            for row in rows
        )
        return (
            f"info[{key!r}] is {', but '.join(values)}: let the environment set a number there in "
            "each step"
        )
    return ""
