"""What a foreign policy returns, checked against the action space, or read as logits."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from skillweave.messages import short, told
from skillweave.types import Array, SkillweaveError


def called(function: Any, argument: Any, who: str, elapsed: Any = None) -> Any:
    """What a function of the user's returns.

    Raises:
        SkillweaveError: it failed; the message names ``who``, the step where it is known, and the
            line.
    """
    try:
        return function(argument)
    except SkillweaveError:
        raise
    except Exception as error:
        # numpy says no more than that something cannot be written to
        hint = "; what it is given cannot be changed: change a copy"
        hint = hint if "read-only" in told(error) else ""
        about = getattr(argument, "shape", None)
        given = "" if about is None else f" for observations of shape {about}"
        raise SkillweaveError(
            f"{who} raised {told(error)}{at_step(elapsed)}{given}{hint}"
        ) from error


def at_step(elapsed: Any) -> str:
    """When something happened, for messages; None: nobody knows."""
    return "" if elapsed is None else f" at step {np.max(elapsed)}"


def as_array(value: Any, who: str) -> Array:
    """``value`` as an array.

    Raises:
        SkillweaveError: it cannot be one; the message names ``who``.
    """
    try:
        return np.asarray(value)
    except Exception as error:
        raise SkillweaveError(
            f"{who} returned {short(value)}, which is no array: {told(error)}"
        ) from error


def checked_actions(value: Any, n: int, space: Space[Any], who: str) -> Array:
    """``value`` as actions (n, *shape) of ``space``; those of a Box are clipped to its bounds.

    Raises:
        SkillweaveError: another shape, another kind of number, or a choice that does not exist;
            the message names ``who`` and the space.
    """
    action, shape = as_array(value, who), (n, *(space.shape or ()))
    if action.shape != shape:
        raise SkillweaveError(
            f"{who} returned shape {action.shape}, but {shape} was expected: one action of {space} "
            f"for each of the {n} environments"
        )
    real = np.issubdtype(space.dtype, np.floating)
    if action.dtype.kind not in ("iubf" if real else "iub"):
        wanted = "numbers" if real else "whole numbers"
        raise SkillweaveError(f"{who} returned {action.dtype}, but actions of {space} are {wanted}")
    if isinstance(space, Box):
        if not np.isfinite(action).all():
            raise SkillweaveError(f"{who} returned a NaN or an infinity as an action of {space}")
        return action.clip(space.low, space.high).astype(space.dtype, copy=False)
    bounds = _bounds(space)
    if bounds is not None and ((action < bounds[0]) | (action >= bounds[1])).any():
        wrong = action[(action < bounds[0]) | (action >= bounds[1])][0]
        raise SkillweaveError(f"{who} returned {wrong}, which is no action of {space}")
    return action.astype(space.dtype, copy=False)


def decoded(
    output: Array,
    n: int,
    space: Space[Any],
    who: str,
    *,
    mask: Array | None = None,
    deterministic: bool = True,
    rng: np.random.Generator | None = None,
) -> Array:
    """A network's output as actions.

    Whole numbers are actions, and so is everything for a Box. Other numbers are logits: (n, A) of
    Discrete(A), concatenated (n, ΣA) of a MultiDiscrete, one for each bit of a MultiBinary; greedy
    takes the largest, else they are sampled with ``rng``.
    """
    shape = space.shape or ()
    if output.dtype.kind in "iub" or isinstance(space, Box):
        flat = output.shape == (n, int(np.prod(shape)))  # a last layer knows no other shape
        return checked_actions(output.reshape(n, *shape) if flat else output, n, space, who)
    width = _width(space)
    if output.shape != (n, width):
        raise SkillweaveError(
            f"{who} returned shape {output.shape}, but {(n, width)} was expected: logits for the "
            f"actions of {space}"
        )
    if np.isnan(output).any():
        raise SkillweaveError(f"{who} returned NaN as a logit")
    rng = rng or np.random.default_rng()
    if isinstance(space, MultiBinary):
        noise = 0.0 if deterministic else rng.logistic(size=output.shape)
        bits: Array = (output + noise > 0).reshape(n, *shape).astype(space.dtype)
        return bits
    if mask is not None and mask.shape == output.shape:
        output = np.where(mask, output, -np.inf)
    if not deterministic:
        output = output + rng.gumbel(size=output.shape)  # argmax of it is a softmax sample
    ends = np.cumsum(_choices(space))[:-1]
    action = np.stack([part.argmax(-1) for part in np.split(output, ends, axis=1)], axis=1)
    start = np.asarray(space.start)  # type: ignore[attr-defined]
    choices: Array = (action.reshape(n, *shape) + start).astype(space.dtype)
    return choices


def _choices(space: Space[Any]) -> list[int]:
    if isinstance(space, Discrete):
        return [int(space.n)]
    assert isinstance(space, MultiDiscrete)
    return [int(k) for k in space.nvec.reshape(-1)]


def _width(space: Space[Any]) -> int:
    if isinstance(space, MultiBinary):
        return int(np.prod(space.shape))
    if isinstance(space, Discrete | MultiDiscrete):
        return sum(_choices(space))
    raise SkillweaveError(f"a network's output cannot be read as actions of {space}")


def _bounds(space: Space[Any]) -> tuple[Any, Any] | None:
    """First choice and the one after the last."""
    if isinstance(space, Discrete):
        return space.start, space.start + space.n
    if isinstance(space, MultiDiscrete):
        return space.start, space.start + space.nvec
    return (0, 2) if isinstance(space, MultiBinary) else None
