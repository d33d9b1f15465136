"""The state that a user's function may change: attributes of objects, and random generators."""

from __future__ import annotations

import copy
import inspect
import random
import sys
import types
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from typing import Any, Literal

import numpy as np

from skillweave._internal.tracebacks import is_own_code

OTHERS = ("torch", "gymnasium")
"""Packages whose objects may keep a state: modules and environments."""
CHANGING = (dict, list, set, deque, np.ndarray)
"""Kinds of attributes that a function may change in place."""
MOST_KEYS = 256
"""The most keys of a dict that is searched for a state."""
DEPTH = 3
"""The most objects between a function and an attribute that it writes."""
MODE: ContextVar[Literal["usual", "examples", "off"]] = ContextVar("MODE", default="usual")
"""Mode of the checks of functions; "examples": their observations are not an environment's."""

Attributes = list[tuple[dict[str, Any], dict[str, Any]]]
"""The dicts of attributes of objects, and their values at one time."""


class FunctionState:
    """The state that a function may change: attributes of the user's objects, and generators.

    Args:
        function: of the user; also an object.
        more: arguments, which may be generators.
    """

    def __init__(self, function: Any, more: tuple[Any, ...] = ()) -> None:
        found = list(_reachable(function, {}))
        self._spaces = [x for x in found if isinstance(x, dict)]
        self._generators = [x for x in found if not isinstance(x, dict)]
        self._generators += [x for x in more if isinstance(x, tuple(GENERATORS))]
        self._generators += _global_generators()
        self._before = self._copies()
        self._random_before = [*map(_random_state, self._generators)]
        self._after: Attributes = []
        self._keep = False

    def _copies(self) -> Attributes:
        return [(space, {k: _copied(v) for k, v in space.items()}) for space in self._spaces]

    def written(self) -> list[str]:
        """Return the names of the attributes that have changed."""
        return [
            str(name)
            for space, values in self._before
            for name, value in space.items()
            if not isinstance(value, tuple(GENERATORS)) and not _equal(value, values.get(name))
        ]

    def random(self) -> bool:
        """Return whether a generator was used."""
        now = map(_random_state, self._generators)
        return not all(map(_same, now, self._random_before))

    @contextmanager
    def restored_afterwards(self) -> Iterator[None]:
        """Restore all as it is now after the block, which may change it; looks are off in it."""
        originals = [(space, dict(space)) for space in self._spaces]
        generators = [_random_state(x) for x in self._generators]
        self._after = self._copies()
        mode = MODE.set("off")
        try:
            yield
        finally:
            MODE.reset(mode)
            _put(originals)
            for generator, state in zip(self._generators, generators, strict=True):
                _set_random_state(generator, state)

    def prepare(self, *, alone: bool = False) -> None:
        """Set the state of after the function's call, and generators as before it.

        Args:
            alone: the state of before the call.
        """
        if alone or not self._keep:
            _put(self._before if alone else self._after, _copied)
        for generator, state in zip(self._generators, self._random_before, strict=True):
            _set_random_state(generator, state)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Let the state run on from call to call within the block."""
        self._keep = True
        try:
            yield
        finally:
            self._keep = False


@contextmanager
def untouched(thing: Any) -> Iterator[None]:
    """Restore random generators, and the attributes of objects, after the block.

    Args:
        thing: a function or an object of the user.
    """
    state = FunctionState(thing)
    with state.restored_afterwards():
        state.prepare()
        yield


@contextmanager
def examples(thing: Any) -> Iterator[None]:
    """Let functions answer about examples, not about what an environment gave; see ``untouched``.

    Each function is looked at once.
    """
    with untouched(thing):
        mode = MODE.set("examples")
        try:
            yield
        finally:
            MODE.reset(mode)


def _put(attributes: Attributes, how: Callable[[Any], Any] = lambda value: value) -> None:
    for space, values in attributes:
        for name in space.keys() - values.keys():
            del space[name]
        space.update({name: how(value) for name, value in values.items()})


GENERATORS: dict[type, tuple[Callable[[Any], Any], Callable[[Any, Any], Any]]] = {
    random.Random: (lambda g: g.getstate(), lambda g, state: g.setstate(state)),
    np.random.Generator: (
        lambda g: g.bit_generator.state,
        lambda g, state: setattr(g.bit_generator, "state", state),
    ),
    np.random.RandomState: (lambda g: g.get_state(), lambda g, state: g.set_state(state)),
}
"""Kinds of random generators: how their state is read and set."""


def _global_generators() -> Iterator[Any]:
    """Yield the global generators that a user's function may draw from; torch if imported."""
    yield random.random.__self__  # type: ignore[attr-defined]
    yield np.random.get_state.__self__  # type: ignore[attr-defined]
    if (torch := sys.modules.get("torch")) is not None:
        yield torch.default_generator


def _random_state(generator: Any) -> Any:
    for kind, (read, _) in GENERATORS.items():
        if isinstance(generator, kind):
            return read(generator)
    return generator.get_state().numpy()


def _set_random_state(generator: Any, state: Any) -> None:
    """Set the state of a random generator that a user's function may have drawn from."""
    for kind, (_, write) in GENERATORS.items():
        if isinstance(generator, kind):
            write(generator, state)
            return
    generator.set_state(sys.modules["torch"].from_numpy(state))


def _reachable(thing: Any, known: dict[int, Any], depth: int = DEPTH) -> Iterator[Any]:
    """Yield the attributes of the user's objects in a function or an object, dicts and generators.

    Args:
        known: the objects that were searched, by ``id``.
    """
    while isinstance(thing, partial):
        thing = thing.func
    if id(thing) in known:
        return
    known[id(thing)] = thing
    if isinstance(thing, types.MethodType):
        yield from _reachable(thing.__func__, known, depth)
        yield from _reachable(thing.__self__, known, depth)
        return
    kinds = type(thing).__mro__
    if isinstance(thing, tuple(GENERATORS)) or (
        kinds[0].__module__ == "torch._C" and (kinds[0].__name__ == "Generator")
    ):
        yield thing
        return
    if isinstance(thing, types.FunctionType):
        if not is_own_code(thing):
            return
        space = {}
        with suppress(ValueError):  # of empty cells
            outside = inspect.getclosurevars(thing)
            space = {**outside.globals, **outside.nonlocals}
    elif is_own_code(kinds[0]) and not any(x.__module__.startswith(OTHERS) for x in kinds):
        space = getattr(thing, "__dict__", {})
        yield space
    elif isinstance(thing, dict) and len(thing) < MOST_KEYS:
        space = thing
        yield space
    else:
        return
    for value in list(space.values()) if depth else ():
        yield from _reachable(value, known, depth - 1)


def _same(state: Any, other: Any) -> bool:
    """Return whether two states of a user's random generator are the same."""
    if isinstance(state, dict):
        return all(map(_same, state.values(), other.values()))
    if isinstance(state, tuple):
        return all(map(_same, state, other))
    return bool(np.array_equal(state, other))


def _copied(value: Any) -> Any:
    """Return a copy of a user's attribute that may change in place; of others the value itself."""
    try:
        return copy.deepcopy(value) if isinstance(value, CHANGING) else value
    except Exception:  # it cannot be copied
        return value


def _equal(one: Any, other: Any) -> bool:
    """Return whether two values of a user's attribute are equal but for rounding."""
    try:
        return bool(np.isclose(one, other, rtol=1e-4, atol=1e-6, equal_nan=True).all())
    except Exception:  # of texts, parts with names, and objects
        return repr(one) == repr(other)
