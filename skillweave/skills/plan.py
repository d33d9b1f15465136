"""A mapping fitted to spaces: inputs made of observations, and actions made of outputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple

from skillweave.arguments import meant
from skillweave.errors import PolicyError
from skillweave.messages import short, shortened
from skillweave.skills.foreign_policy import made_up
from skillweave.skills.mapping import (
    Acts,
    Computed,
    Goal,
    LastAction,
    Part,
    PolicyMapping,
    Source,
    places_to_json,
    source_to_json,
)
from skillweave.skills.outputs import as_array, called, checked_actions, decoded
from skillweave.types import Array, Memory, read_only

Shapes = Mapping[str, tuple[int | None, ...] | None]
"""Shapes of a model's inputs for one environment, by name; None: unknown."""

# Observations


@dataclass(frozen=True)
class Leaf:
    """A part of an observation that has no parts itself."""

    fields: tuple[str, ...]
    """The names that lead to it in a packed observation."""
    shape: tuple[int, ...]
    choices: tuple[int, ...]
    """The number of choices of each entry; empty: it holds numbers."""
    start: tuple[int, ...]
    """The first choice of each entry."""
    image: bool

    @property
    def name(self) -> str:
        """Return its name, ``arm.joints``."""
        return ".".join(self.fields)

    @property
    def size(self) -> int:
        """Return the number of its numbers in the flat form, choices one-hot."""
        return sum(self.choices) if self.choices else int(np.prod(self.shape))


def leaves_of(space: Space[Any], names: tuple[str, ...] = ()) -> list[Leaf]:
    """Return the leaves of an observation space, in order."""
    from skillweave.spaces.observations import image_layout
    from skillweave.spaces.packing import obs_dtype, parts

    inner = parts(space)
    if inner is not None:
        return [leaf for k, part in inner.items() for leaf in leaves_of(part, (*names, k))]
    obs_dtype(space)  # raises where the space is not supported
    choices: tuple[int, ...] = ()
    start: tuple[int, ...] = ()
    if isinstance(space, Discrete):
        choices = (int(space.n),)
        start = (int(space.start),)
    elif isinstance(space, MultiDiscrete):
        choices = tuple(space.nvec.reshape(-1).tolist())
        start = tuple(np.broadcast_to(space.start, space.shape).reshape(-1).tolist())
    return [Leaf(names, tuple(space.shape or ()), choices, start, image_layout(space) is not None)]


@dataclass(frozen=True, eq=False)
class _Read:
    """Numbers of one leaf."""

    leaf: Leaf
    places: slice | Array | None = None
    one_hot: bool = True
    whole: bool = False
    """The leaf keeps its shape."""

    def __call__(self, obs: Array, goal: Array | None, last: Array | None) -> Array:
        for name in self.leaf.fields:
            obs = obs[name]
        if self.whole:
            return obs
        if self.leaf.choices and self.one_hot:
            flat = obs.reshape(len(obs), -1) - np.array(self.leaf.start)
            hot = [np.eye(n)[flat[:, i]] for i, n in enumerate(self.leaf.choices)]
            obs = hot[0] if len(hot) == 1 else np.concatenate(hot, axis=1)
        elif obs.ndim != 2:
            obs = obs.reshape(len(obs), -1)
        return obs if self.places is None else obs[:, self.places]


@dataclass(frozen=True, eq=False)
class _Goal:
    """The goal, within its range."""

    place: Goal

    def __call__(self, obs: Array, goal: Array | None, last: Array | None) -> Array:
        assert goal is not None
        if self.place.low is not None:
            goal = np.maximum(goal, self.place.low)
        return goal if self.place.high is None else np.minimum(goal, self.place.high)


@dataclass(frozen=True)
class _Last:
    """The last output."""

    def __call__(self, obs: Array, goal: Array | None, last: Array | None) -> Array:
        assert last is not None
        return last


@dataclass(frozen=True)
class _Computed:
    """The numbers that a function of the user makes of observations."""

    function: Callable[[Array], Any]
    who: str
    shape: tuple[int, ...] | None = None
    """Of one environment; None: any."""

    def __call__(self, obs: Array, goal: Array | None, last: Array | None) -> Array:
        return numbers_of(self.function, obs, self.who, self.shape)


def numbers_of(
    function: Callable[[Array], Any], obs: Array, who: str, shape: tuple[int, ...] | None = None
) -> Array:
    """Return the numbers (n, ...) that a user's function makes of observations; (n,) as (n, 1).

    Raises:
        PolicyError: it returned something else, or another ``shape`` of one environment.
    """
    values = as_array(called(function, read_only(obs), who, kind=PolicyError), who, PolicyError)
    if values.shape[:1] != (len(obs),) or values.dtype.kind not in "iubf":
        raise PolicyError(
            f"{who} returned {values.dtype} of shape {values.shape}, but numbers of shape "
            f"({len(obs)}, ...) were expected: a row for each environment"
        )
    values = values[:, None] if values.ndim == 1 else values
    if shape is not None and values.shape[1:] != shape:
        raise PolicyError(
            f"{who} returned numbers of shape {values.shape[1:]} for each environment, but {shape} "
            "at first"
        )
    return values


@dataclass(frozen=True, eq=False)
class _Linear:
    """A ``Scaling`` of a whole input, as arrays; None: that part of it changes nothing."""

    offset: Array | None
    scale: Array | None
    low: Array | None
    high: Array | None

    def __call__(self, x: Array) -> Array:
        if self.offset is not None:
            x = x - self.offset
        if self.scale is not None:
            x = x * self.scale
        if self.low is not None and self.high is not None:
            x = np.minimum(np.maximum(x, self.low), self.high)
        return x


def _scaling(parts: Sequence[tuple[Any, int, str]], shape: tuple[int, ...]) -> tuple[_Linear, ...]:
    """Return the scaling of an input of parts: settings, width, and name in messages of each."""

    def joined(name: str, default: float) -> Array | None:
        values = [getattr(settings, name) for settings, _, _ in parts]
        if all(value == default for value in values):
            return None
        wide = [
            _wide(value, n, f"{where}.{name}")
            for value, (_, n, where) in zip(values, parts, strict=True)
        ]
        return np.concatenate(wide).reshape(shape)

    low: list[Array] = []
    high: list[Array] = []
    for settings, n, _ in parts:
        lowest, highest = settings.clip or (-np.inf, np.inf)
        low.append(np.full(n, lowest))
        high.append(np.full(n, highest))
    clips = any(settings.clip is not None for settings, _, _ in parts)
    scaling = _Linear(
        joined("offset", 0.0),
        joined("scale", 1.0),
        np.concatenate(low).reshape(shape) if clips else None,
        np.concatenate(high).reshape(shape) if clips else None,
    )
    changes = clips or scaling.offset is not None or scaling.scale is not None
    return (scaling,) if changes else ()


def _wide(value: float | tuple[float, ...], n: int, where: str) -> Array:
    """Return one number as n, or check that there are n."""
    if isinstance(value, tuple) and len(value) != n:
        raise PolicyError(f"{where} has {len(value)} numbers, but it scales {n}")
    return np.broadcast_to(np.array(value, np.float64), (n,))


@dataclass(frozen=True, eq=False)
class Input:
    """One input of a policy, for an observation space."""

    pieces: tuple[Callable[[Array, Array | None, Array | None], Array], ...]
    scalings: tuple[_Linear, ...]
    shape: tuple[int, ...]
    """Of one environment."""
    sources: tuple[tuple[Source, int], ...]
    """The source of each piece, and the number of its numbers."""
    reshaped: bool = False
    """It is brought to its shape: one number with or without an axis of its own."""

    def __call__(self, obs: Array, goal: Array | None, last: Array | None) -> Array:
        values = [piece(obs, goal, last) for piece in self.pieces]
        x = values[0] if len(values) == 1 else np.concatenate(values, axis=1)
        for scaling in self.scalings:
            x = scaling(x)
        return x.reshape(len(x), *self.shape) if self.reshaped else x

    @property
    def described(self) -> str:
        """Return how many numbers it has, and of which sources, for messages."""
        sizes = ", ".join(f"{_described(source)} {n}" for source, n in self.sources)
        return f"{int(np.prod(self.shape))} numbers ({shortened(sizes, 300)})"

    @property
    def leaves(self) -> list[tuple[Leaf | None, bool]]:
        """Return the leaf that each piece reads, and True if it reads all of it as it is.

        None: a piece reads no leaf.
        """
        return [
            (p.leaf, p.whole or (p.places is None and not p.leaf.choices))
            if isinstance(p, _Read)
            else (None, False)
            for p in self.pieces
        ]

    def to_json(self, names: Mapping[int, str]) -> list[dict[str, Any]]:
        """Return its sources for files: each names one leaf, with its fields and choices.

        ``names`` has the names of the user's functions, by ``id``.
        """
        content = []
        for piece, (source, _) in zip(self.pieces, self.sources, strict=True):
            entry = source_to_json(source, names)
            if isinstance(piece, _Read):
                leaf = piece.leaf
                hot = piece.one_hot and not piece.whole
                at = piece.places
                entry |= {
                    "key": leaf.name,
                    "places": places_to_json(
                        tuple(at.tolist()) if isinstance(at, np.ndarray) else at
                    ),
                    "fields": list(leaf.fields),
                    "choices": [list(x) for x in zip(leaf.choices, leaf.start, strict=True)] * hot,
                    "whole": piece.whole,
                }
            content.append(entry)
        return content


# The plan


class Plan:
    """A mapping fitted to spaces.

    Args:
        mapping: the mapping.
        observation_space: the environment's.
        action_space: the environment's.
        expected: the shapes of the model's inputs, without those of its state; empty: unknown.
        who: begins messages.
        states: the shapes of the recurrent state of one environment, and its type.
        goal_size: the numbers of the goal of the skill; None: it has no goals.

    Raises:
        PolicyError: the mapping does not fit the spaces or the model; the message names the field.
    """

    def __init__(
        self,
        mapping: PolicyMapping,
        observation_space: Space[Any],
        action_space: Space[Any],
        expected: Shapes,
        who: str,
        states: Sequence[tuple[tuple[int, ...], Any]] = (),
        goal_size: int | None = None,
    ) -> None:
        self.mapping = mapping
        self.who = who
        if mapping.chunk is not None and isinstance(action_space, Dict | Tuple):
            raise PolicyError(
                f"{who}: chunk needs actions of one array, but they are of {short(action_space)}"
            )
        self.spaces = observation_space, action_space
        self.outputs = Outputs(mapping.acts, action_space, who)
        self.states = tuple(states)
        self.state_keys = tuple(f"state.{i}" for i in range(len(self.states)))
        self._leaves = [] if mapping.sees is None else leaves_of(observation_space)
        self._goal = self._fitted_goal()
        self._goal_shape: tuple[int, ...] | None = None if goal_size is None else (goal_size,)
        self._has_goal = any(isinstance(s, Goal) for s in mapping.sources())
        self.inputs: dict[str, Input] | None = None
        self.remembers_nothing = (
            mapping.period == 1
            and mapping.chunk is None
            and not self.states
            and not mapping.remembers_output
        )
        if mapping.remembers_output and not isinstance(action_space, Box):
            raise PolicyError(
                f"{who}: sees has LastAction(), which needs actions of a Box, not {action_space}"
            )
        if mapping.sees is not None:
            self.inputs = {name: self._input(name, parts) for name, parts in mapping.sees.items()}
            self._check(expected)

    def start(self, n: int) -> Memory:
        """Return the memory of n environments in which the policy has not acted yet."""
        memory: Memory = {}
        for key, (shape, dtype) in zip(self.state_keys, self.states, strict=True):
            memory[key] = np.zeros((n, *shape), dtype)
        if self.mapping.remembers_output:
            memory["last"] = np.zeros((n, self.outputs.count), np.float64)
        if self.mapping.period > 1:
            from skillweave.spaces.packing import obs_dtype, obs_shape  # needs torch

            space = self.spaces[1]
            action = np.zeros((n, *obs_shape(space)), obs_dtype(space))
            held = self.held([action] * (self.mapping.chunk or 1))
            memory |= {"phase": np.zeros(n, np.int64), "held": held}
        return memory

    def held(self, actions: Sequence[Array]) -> Array:
        """Return actions of K inferences, (n, …) each, as a memory stores them: (n, K, …).

        Those of a Dict or Tuple are stored as bytes.
        """
        held = np.stack(actions, axis=1)
        if held.dtype.fields is None:
            return held
        return held.view(np.uint8).reshape(*held.shape, held.dtype.itemsize)

    def of_held(self, held: Array, at: Array) -> Array:
        """Return of ``held`` actions (n, K, …) those at places ``at`` (n,)."""
        action: Array = held[np.arange(len(held)), at]
        if not isinstance(self.spaces[1], Dict | Tuple):
            return action
        from skillweave.spaces.packing import obs_dtype  # needs torch

        return np.ascontiguousarray(action).view(obs_dtype(self.spaces[1])).reshape(len(held))

    def read(self, obs: Array, last: Array | None, goal: Array | None) -> dict[str, Array]:
        """Return the inputs of n observations, by name."""
        assert self.inputs is not None
        if self._has_goal and goal is None:
            goal = self.goal(obs)
        elif goal is not None and goal.shape != (len(obs), *(self._goal_shape or ())):
            raise PolicyError(
                f"{self.who}: the goal has shape {goal.shape}, but {self._goal_shape} was expected "
                f"for each of {len(obs)} environments"
            )
        return {name: part(obs, goal, last) for name, part in self.inputs.items()}

    def goal(self, obs: Array) -> Array:
        """Return the goals (n, G): the fixed one, or those of the user's function."""
        if isinstance(self._goal, np.ndarray):
            return self._goal if len(obs) == 1 else self._goal.repeat(len(obs), axis=0)
        assert self._goal is not None
        return numbers_of(self._goal, obs, f"{self.who}: goal()", self._goal_shape)

    def _fitted_goal(self) -> Array | Callable[[Any], Any] | None:
        goal = self.mapping.goal
        if not isinstance(goal, tuple):
            return goal
        fixed = np.array([goal])
        fixed.setflags(write=False)
        return fixed

    def _input(self, name: str, parts: tuple[Source, ...]) -> Input:
        field = f"sees[{name!r}]" if name else "sees"
        alone = len(parts) == 1
        pieces: list[Any] = []
        sources: list[tuple[Source, int]] = []
        scaled: list[tuple[Any, int, str]] = []
        shape: tuple[int, ...] | None = None
        for i, source in enumerate(parts):
            where = f"{self.who}: {field}" + ("" if alone else f"[{i}]")
            found: list[tuple[Any, Source, int]]
            if isinstance(source, Part):
                found = self._reads(source, alone, where)
                if alone and len(found) == 1 and found[0][0].whole:
                    shape = found[0][0].leaf.shape
            elif isinstance(source, Goal):
                found = [(_Goal(source), source, self._goal_width(where))]
            elif isinstance(source, LastAction):
                found = [(_Last(), source, self.outputs.count)]
            else:
                assert source.function is not None
                piece = _Computed(source.function, f"{where}, a function,")
                values = piece(made_up(self.spaces[0], 2), None, None)
                if values.ndim > 2 and not alone:
                    raise PolicyError(
                        f"{where}: a function beside other parts must return (n, numbers), not "
                        f"shape {values.shape}"
                    )
                shape = values.shape[1:] if alone else None
                piece = replace(piece, shape=values.shape[1:])
                found = [(piece, source, int(np.prod(values.shape[1:])))]
            pieces += [piece for piece, _, _ in found]
            sources += [(s, n) for _, s, n in found]
            scaled.append((source, sum(n for _, _, n in found), where))
        width = sum(n for _, n in sources)
        shape = (width,) if shape is None else shape
        scalings = _scaling(scaled, shape)
        if (last := self.mapping.scaling.get(name)) is not None:
            scalings += _scaling([(last, width, f"{self.who}: scaling")], shape)
        return Input(tuple(pieces), scalings, shape, tuple(sources))

    def _goal_width(self, where: str) -> int:
        if self._goal_shape is not None:  # the goals of a skill
            return self._goal_shape[0]
        if self._goal is None:
            raise PolicyError(
                f"{where} is Goal(), but there is no goal: give goal=, numbers or a function of "
                "observations; or goal_space, to a skill that is called with goals"
            )
        self._goal_shape = self.goal(made_up(self.spaces[0], 2)).shape[1:]
        if len(self._goal_shape) != 1:
            raise PolicyError(f"{self.who}: goal() must return (n, numbers)")
        return int(self._goal_shape[0])

    def _reads(self, part: Part, alone: bool, where: str) -> list[tuple[Any, Source, int]]:
        """Return the leaves that a part reads, a piece of each in the part's order."""
        key = part.key
        leaves = [leaf for leaf in self._leaves if not key or f"{leaf.name}.".startswith(f"{key}.")]
        if not leaves:
            names = [leaf.name for leaf in self._leaves]
            if names == [""]:
                raise PolicyError(
                    f"{where} reads {key!r}, but the observation is no Dict: it is {self.spaces[0]}"
                )
            raise PolicyError(
                f"{where} reads {key!r}, which the observation does not have; its parts are "
                f"{', '.join(names)}"
            )
        if len(leaves) == 1 and part.places is None:
            leaf = leaves[0]
            whole = alone and (len(leaf.shape) > 1 or not part.one_hot)
            size = leaf.size if part.one_hot else int(np.prod(leaf.shape))
            return [(_Read(leaf, None, part.one_hot, whole), part, size)]
        if len(leaves) > 1:
            leaves = [leaf for leaf in leaves if not leaf.image]
        sizes = [leaf.size if part.one_hot else int(np.prod(leaf.shape)) for leaf in leaves]
        if not leaves:
            raise PolicyError(f"{where} reads {key!r}, which has images alone: name one of them")
        places = places_in(part.places, sum(sizes), f"{where}.places")
        first = np.concatenate([[0], np.cumsum(sizes)])
        owner = np.searchsorted(first, places, side="right") - 1
        cuts = np.flatnonzero(np.diff(owner)) + 1
        found: list[tuple[Any, Source, int]] = []
        for run in np.split(np.arange(len(places)), cuts):
            at = owner[run[0]]
            inner = places[run] - first[at]
            piece = _Read(leaves[at], _as_slice(inner), part.one_hot)
            found.append((piece, _share(part, run), len(run)))
        return found

    def _check(self, expected: Shapes) -> None:
        """Raise where an input of the model is not set, does not exist, or has another shape."""
        assert self.inputs is not None
        if not expected:
            return
        if set(self.inputs) == {""} and len(expected) == 1:
            expected = {"": next(iter(expected.values()))}
        named = ", ".join(expected)
        for name in expected:
            if name not in self.inputs:
                raise PolicyError(
                    f"{self.who}: sees does not set the input {name!r}; the policy takes {named}: "
                    f"write sees={{{name!r}: ..., ...}}"
                )
        for name, given in list(self.inputs.items()):
            if name not in expected:
                raise PolicyError(
                    f"{self.who}: sees has an input {name!r}, which the policy does not take"
                    + meant(name, list(expected), "it takes")
                )
            wanted = expected[name]
            field = f"sees[{name!r}]" if name else "sees"
            if wanted is None or _fits(given.shape, wanted):
                continue
            if wanted in ((), (1,)) and given.shape in ((), (1,)):
                exact = (1,) * len(wanted)
                self.inputs[name] = replace(given, shape=exact, reshaped=True)
                continue
            numbers = _product(wanted)
            size = int(np.prod(given.shape))
            text = f"{self.who}: {field} gives {given.described}"
            if numbers is None or numbers == size:
                shape = "(" + ", ".join("n" if x is None else str(x) for x in wanted) + ")"
                raise PolicyError(
                    f"{text} of shape {given.shape}, but the policy takes {shape}: let a function "
                    "of observations give the input its shape"
                )
            lacks = f": {numbers - size} stay unset" if numbers > size else ""
            raise PolicyError(f"{text}, but the policy takes {numbers}{lacks}")


def _share(part: Part, run: Array) -> Part:
    """Return a part with the scale and offset of a run of its numbers alone."""
    some = slice(int(run[0]), int(run[-1]) + 1)
    share: dict[str, Any] = {
        name: value[some]
        for name in ("scale", "offset")
        if isinstance(value := getattr(part, name), tuple)
    }
    return replace(part, **share)


def places_in(places: slice | tuple[int, ...] | None, size: int, where: str) -> Array:
    """Return places as an array; check that they are below ``size``."""
    if places is None:
        return np.arange(size)
    if isinstance(places, slice):
        found = np.arange(size)[places]
        outside = [x for x in (places.start, places.stop) if x is not None and abs(x) > size]
        if len(found) and not outside:
            return found
    elif max(places) < size:
        return np.array(places)
    raise PolicyError(
        f"{where} is {short(places)}, but there are {size} numbers, at places 0 to {size - 1}"
    )


def _as_slice(places: Array) -> slice | Array:
    """Return places that follow one another as a slice, which reads without a copy."""
    first = int(places[0])
    if (places == np.arange(first, first + len(places))).all():
        return slice(first, first + len(places))
    return places


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(shape) == len(wanted) and all(
        b is None or a == b for a, b in zip(shape, wanted, strict=True)
    )


def _product(shape: tuple[int | None, ...]) -> int | None:
    sizes = [n for n in shape if n is not None]
    return int(np.prod(sizes)) if len(sizes) == len(shape) else None


def _described(source: Source) -> str:
    if isinstance(source, Part):
        return source.key or "the observation"
    return "a function" if isinstance(source, Computed) else f"{type(source).__name__}()"


class Outputs:
    """The meaning of a policy's outputs, for an action space.

    Raises:
        PolicyError: ``acts`` does not fit the space; the message begins with ``who``.
    """

    def __init__(self, acts: Acts | None, space: Space[Any], who: str) -> None:
        self.acts = acts
        self.space = space
        self.who = who
        self.count = 0
        """The number of outputs that are numbers of an action."""
        self.to: Array | None = None
        if isinstance(space, Box):
            self.count = int(np.prod(space.shape))
        if acts is None:
            return
        if isinstance(space, Discrete):
            if not acts.plain:
                raise PolicyError(
                    f"{who}: acts has scale, offset, clip or rest, but actions are choices of "
                    f"{space}; only to applies there"
                )
            if acts.to is not None:
                self.to = self._places(acts, int(space.n))
                self.count = len(self.to)
            return
        if not isinstance(space, Box):
            raise PolicyError(f"{who}: acts needs actions of a Box or a Discrete, not {space}")
        size = self.count
        if acts.to is not None:
            self.to = self._places(acts, size)
            self.count = len(self.to)
        left = size - self.count
        if left and acts.rest is None:
            raise PolicyError(
                f"{who}: acts writes {self.count} of {size} numbers of an action; give the others "
                "as Acts(..., rest=0.0)"
            )
        if not left and acts.rest is not None:
            raise PolicyError(f"{who}: acts has rest, but its outputs are all numbers of an action")
        self.scale = _wide(acts.scale, self.count, f"{who}: acts.scale")
        self.offset = _wide(acts.offset, self.count, f"{who}: acts.offset")
        self.same = acts.scale == 1.0 and acts.offset == 0.0
        self.template = np.zeros((1, size))
        if self.to is not None and left:
            others = np.setdiff1d(np.arange(size), self.to)
            self.template[0, others] = _wide(acts.rest, left, f"{who}: acts.rest")

    def __call__(
        self,
        output: Array,
        n: int,
        logits: bool,
        mask: Array | None,
        deterministic: bool,
        rng: np.random.Generator | None,
    ) -> tuple[Array, Array | None]:
        """Return actions (n, ...) for outputs (n, ...), and the outputs that a policy remembers.

        Args:
            logits: numbers that are no whole numbers are logits of choices, as of a network.
            mask: (n, A) bool, allowed actions; None: all.
        """
        acts = self.acts
        space = self.space
        if isinstance(space, Box):
            if acts is None:
                return self._checked(output, n, space, logits, mask, deterministic, rng), output
            numbers = self._numbers(output, n)
            return self._scaled(acts, numbers, space), numbers
        if self.to is None:
            return self._checked(output, n, space, logits, mask, deterministic, rng), None
        assert isinstance(space, Discrete)
        allowed = mask[:, self.to] if mask is not None and mask.shape[1] == space.n else None
        inner = Discrete(self.count)
        choice = self._checked(output, n, inner, logits, allowed, deterministic, rng)
        return (self.to[choice] + space.start).astype(space.dtype), None

    def _checked(
        self,
        output: Array,
        n: int,
        space: Space[Any],
        logits: bool,
        mask: Array | None,
        deterministic: bool,
        rng: np.random.Generator | None,
    ) -> Array:
        if not logits:
            return checked_actions(output, n, space, self.who)
        how: Any = {"mask": mask, "deterministic": deterministic, "rng": rng}
        return decoded(output, n, space, self.who, **how)

    def _numbers(self, output: Array, n: int) -> Array:
        """Return outputs (n, count), clipped.

        Raises:
            PolicyError: they have another shape, or one is not finite.
        """
        acts = self.acts
        if output.size != n * self.count or output.dtype.kind not in "iuf":
            raise PolicyError(
                f"{self.who} returned {output.dtype} of shape {output.shape}, but numbers of shape "
                f"{(n, self.count)} were expected: acts writes {self.count} numbers of an action"
            )
        if not np.isfinite(output).all():
            raise PolicyError(f"{self.who} returned a NaN or an infinity as an action")
        numbers = output.reshape(n, self.count)
        if acts is not None and acts.clip is not None:
            numbers = np.minimum(np.maximum(numbers, acts.clip[0]), acts.clip[1])
        return numbers

    def _scaled(self, acts: Acts, numbers: Array, space: Box) -> Array:
        """Return actions (n, *shape) for clipped outputs (n, count), within the space's bounds."""
        if not self.same:
            numbers = numbers * self.scale + self.offset
        full = numbers
        if self.to is not None:
            full = self.template.repeat(len(numbers), axis=0)
            full[:, self.to] = numbers
        full = full.reshape(len(numbers), *space.shape)
        if np.issubdtype(space.dtype, np.integer):
            full = np.rint(full)
        return np.minimum(np.maximum(full, space.low), space.high).astype(space.dtype)

    def _places(self, acts: Acts, size: int) -> Array:
        where = f"{self.who}: acts.to"
        try:
            return places_in(acts.to, size, where)
        except PolicyError:
            raise PolicyError(
                f"{where} is {short(acts.to)}, a part of the action that does not exist: "
                f"{self.space} has places 0 to {size - 1}"
            ) from None
