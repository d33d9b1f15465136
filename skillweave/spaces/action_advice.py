"""Errors of unsupported action spaces, with wrappers that make supported ones of them.

Stands alone because it writes code for users, not actions.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.errors import EnvError
from skillweave.messages import short
from skillweave.spaces.packing import parts

ACTIONS = "Discrete, MultiDiscrete, MultiBinary, Box (of floats)"
MOST_CHOICES = 1_000
"""Choices of a whole number of a Box that are worth a network's outputs each."""
_LONGEST = 30
"""Numbers that a message lists one by one."""


def unsupported_action(space: gym.Space[Any]) -> EnvError:
    """Return the error for an action space that is not supported; it shows a wrapper."""
    shown = " ".join(short(space, 200).split())
    return EnvError(
        f"action space {shown} is not supported; supported are: {ACTIONS}. {_way(space)}"
    )


def _way(space: gym.Space[Any]) -> str:
    """Return advice about a space: the lines of a wrapper, if one can be generated."""
    leaves = list(_leaves(space))
    if not leaves or not all(_is_plain(leaf) for leaf in leaves):
        return _wrapped("Let a function make its actions", "function", "gymnasium.spaces.Box(...)")
    if any(_is_real(leaf) for leaf in leaves):
        # Choices beside numbers: each choice has a number, and the largest number is chosen.
        action, _ = _expression(space, 0, one_hot=True)
        flat = "gymnasium.spaces.flatten_space(env.action_space)"
        return _wrapped("Make one Box of it", f"lambda action: {action}", flat)
    sizes, starts = np.array([part for leaf in leaves for part in _choices(leaf)]).T
    if len(sizes) > _LONGEST or max(sizes) > MOST_CHOICES:
        largest = "gymnasium.spaces.Box(-1.0, 1.0, ...)"
        return _wrapped("Let a function round real numbers to it", "function", largest)
    start = f", start={starts.tolist()}" if starts.any() else ""
    if isinstance(space, gym.spaces.Box) and len(sizes) == 1:
        begin = f", start={starts[0]}" if starts[0] else ""
        action = f"numpy.full({space.shape}, action, {str(space.dtype)!r})"
        one = f"gymnasium.spaces.Discrete({sizes[0]}{begin})"
        return _wrapped("Make choices of it", f"lambda action: {action}", one)
    action, _ = _expression(space, 0, one_hot=False)
    if isinstance(space, gym.spaces.Box):
        action = action.replace(f"action[0:{len(sizes)}]", "action")
    many = f"gymnasium.spaces.MultiDiscrete({sizes.tolist()}{start})"
    return _wrapped("Make choices of it", f"lambda action: {action}", many)


def _wrapped(what: str, function: str, space: str) -> str:
    return (
        f"{what}: EnvSpec(env, wrappers=(lambda env: "
        f"gymnasium.wrappers.TransformAction(env, {function}, {space}),))"
    )


def _leaves(space: gym.Space[Any]) -> Iterator[gym.Space[Any]]:
    if not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        yield space
        return
    for part in (parts(space) or {}).values():
        yield from _leaves(part)


def _is_plain(leaf: gym.Space[Any]) -> bool:
    """Return whether a space without parts is of numbers or choices, at least one."""
    if isinstance(leaf, gym.spaces.Box):
        return bool(np.prod(leaf.shape)) and (_is_real(leaf) or leaf.is_bounded())
    kinds = gym.spaces.Discrete | gym.spaces.MultiDiscrete | gym.spaces.MultiBinary
    return isinstance(leaf, kinds)


def _is_real(leaf: gym.Space[Any]) -> bool:
    return isinstance(leaf, gym.spaces.Box) and np.issubdtype(leaf.dtype, np.floating)


def _choices(leaf: gym.Space[Any]) -> list[tuple[int, int]]:
    """Return the number of values and the first value of each choice in a space without parts."""
    if isinstance(leaf, gym.spaces.Discrete):
        return [(int(leaf.n), int(leaf.start))]
    if isinstance(leaf, gym.spaces.MultiDiscrete):
        start = np.broadcast_to(leaf.start, leaf.shape)
        return list(zip(leaf.nvec.reshape(-1).tolist(), start.reshape(-1).tolist(), strict=True))
    if isinstance(leaf, gym.spaces.MultiBinary):
        return [(2, 0)] * int(np.prod(leaf.shape))
    assert isinstance(leaf, gym.spaces.Box)
    low, high = leaf.low.reshape(-1).tolist(), leaf.high.reshape(-1).tolist()
    return [(int(b) - int(a) + 1, int(a)) for a, b in zip(low, high, strict=True)]


def _expression(space: gym.Space[Any], at: int, one_hot: bool) -> tuple[str, int]:
    """Return Python code that builds an action of ``space`` from numbers of ``action`` at ``at``.

    Args:
        one_hot: the numbers are in the format of ``flatten_space``; else one per choice.

    Returns:
        The expression, and where the next numbers begin.
    """
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        members = []
        for name, part in (parts(space) or {}).items():
            one, at = _expression(part, at, one_hot)
            members.append(f"{name!r}: {one}" if isinstance(space, gym.spaces.Dict) else one)
        inside = ", ".join(members)
        if isinstance(space, gym.spaces.Dict):
            return f"{{{inside}}}", at
        return f"({inside},)" if len(members) == 1 else f"({inside})", at
    number = isinstance(space, gym.spaces.Discrete)
    if one_hot and isinstance(space, gym.spaces.Discrete | gym.spaces.MultiDiscrete):
        chosen = []
        for size, start in _choices(space):
            begin = f"{start} + " if start else ""
            chosen.append(f"{begin}action[{at}:{at + size}].argmax()")
            at += size
        if number:
            return f"int({chosen[0]})", at
        return _shaped(f"numpy.array([{', '.join(chosen)}])", space, len(chosen)), at
    if number:
        return f"int(action[{at}])", at + 1
    size = int(np.prod(space.shape or ()))
    some = f"action[{at}:{at + size}]"
    if one_hot and isinstance(space, gym.spaces.MultiBinary):
        some = f"({some} > 0.5)"
    elif one_hot and not _is_real(space):
        some += ".round()"
    return _shaped(some, space, size), at + size


def _shaped(some: str, space: gym.Space[Any], size: int) -> str:
    """Return the expression of ``size`` numbers with the shape and type of a space's actions."""
    shape = "" if space.shape == (size,) else f".reshape({space.shape})"
    return f"{some}{shape}.astype({str(space.dtype)!r})"
