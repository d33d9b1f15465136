"""A mapping fitted to spaces: inputs made of observations, and actions made of outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from typing import Any

import numpy as np
from gymnasium import Space

from skillweave._internal.messages import short, shortened, suggest
from skillweave.errors import PolicyError
from skillweave.policies.core import Array, InCall
from skillweave.policies.mapped import (
    Affine,
    Input,
    Outputs,
    Shapes,
    Take,
    fits_shape,
    numbers_of,
)
from skillweave.policies.spaces import space_of
from skillweave.policies.timed import Clock, Past, Rows
from skillweave.skills.foreign_policy import made_up
from skillweave.skills.function_state import examples
from skillweave.skills.mapping import (
    Acts,
    Elapsed,
    Goal,
    LastAction,
    Part,
    PolicyMapping,
    Source,
    Table,
)
from skillweave.skills.outputs import of_numbers

# Inputs


def fitted_inputs(
    mapping: PolicyMapping, space: Space[Any], who: str, own: Mapping[str, tuple[int, ...]]
) -> dict[str, Input]:
    """Return the inputs of ``mapping.sees``, by name, for observations of a space.

    Args:
        who: begins messages.
        own: the shapes of the goal and of the last action, where there is one.

    Raises:
        PolicyError: a part does not fit the space; the message names the field.
    """
    reader = _Reader(space, own, mapping.entry)
    inputs: dict[str, Input] = {}
    for name, parts in (mapping.sees or {}).items():
        field = f"{who}: {_field(name)}"
        alone = len(parts) == 1
        takes: list[Take] = []
        scaled: list[tuple[Any, int, str]] = []
        for i, source in enumerate(parts):
            where = field if alone else f"{field}[{i}]"
            taken = reader.takes(source, alone, where)
            takes += taken
            scaled.append((source, sum(take.size for take in taken), where))
        width = sum(take.size for take in takes)
        keeps = len(takes) == 1 and (takes[0].whole or takes[0].source == "function")
        shape = takes[0].shape if keeps else (width,)
        past = _past(parts, [size for _, size, _ in scaled])
        if past is not None and keeps:
            raise PolicyError(
                f"{field} has history, but it keeps its shape {shape}: stack frames by a wrapper, "
                "gymnasium.wrappers.FrameStackObservation"
            )
        scalings = _scaling(scaled, shape)
        last = mapping.scaling.get(name)
        if past is not None:
            size = len(past.ages)
            whole = _scaling([(last, size, f"{who}: scaling")], (size,)) if last is not None else ()
            last_scaling = whole[0] if whole else None
            inputs[name] = Input(tuple(takes), (size,), scalings, False, past, last_scaling)
            continue
        if last is not None:
            scalings += _scaling([(last, width, f"{who}: scaling")], shape)
        inputs[name] = Input(tuple(takes), shape, scalings)
    return inputs


def _past(parts: Sequence[Source], sizes: Sequence[int]) -> Past | None:
    """Return the places of an input's numbers in the last inferences; None: it takes one alone.

    Args:
        sizes: of each part, in one inference.
    """
    lengths = [getattr(part, "history", 1) for part in parts]
    if max(lengths) == 1:
        return None
    ends = np.cumsum(sizes)
    columns = [np.arange(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    blocks = list[tuple[Any, Array]]()
    for part, own in zip(parts, columns, strict=True):
        joined = getattr(part, "layout", "term") == "step"
        if joined and blocks and getattr(blocks[-1][0], "layout", "term") == "step":
            blocks[-1] = part, np.concatenate([blocks[-1][1], own])
        else:
            blocks.append((part, own))
    ages, places = list[Array](), list[Array]()
    for part, own in blocks:
        age = np.arange(getattr(part, "history", 1))
        age = age if getattr(part, "order", "oldest") == "newest" else age[::-1]
        ages.append(np.repeat(age, len(own)))
        places.append(np.tile(own, len(age)))
    zeros = [
        own
        for part, own in zip(parts, columns, strict=True)
        if getattr(part, "fill", "first") == "zeros"
    ]
    first = tuple(np.concatenate(zeros).tolist()) if zeros else ()
    return Past(np.concatenate(ages), np.concatenate(places), int(ends[-1]), first)


def _field(name: str) -> str:
    return f"sees[{name!r}]" if name else "sees"


def described(given: Input) -> str:
    """Return how many numbers an input has, and of which sources, for messages."""
    sizes = ", ".join(f"{take.name} {take.size}" for take in given.takes)
    several = "" if given.past is None else f", of the last {given.past.length + 1} inferences"
    return f"{prod(given.shape)} numbers ({shortened(sizes, 300)}{several})"


class _Reader:
    """A reader of observations, for the sources of inputs.

    Args:
        space: of the observations.
        own: as of ``fitted_inputs``.
        entry: the step at which the policy starts.
    """

    def __init__(self, space: Space[Any], own: Mapping[str, tuple[int, ...]], entry: int) -> None:
        from skillweave.spaces.packing import obs_dtype

        obs_dtype(space)  # raises where the space is not supported
        self.space = space
        self.own = own
        self.entry = entry
        self.leaves = space_of(space).leaves

    def takes(self, source: Source, alone: bool, where: str) -> list[Take]:
        """Return the numbers that a source takes of observations, as ``Take`` of each leaf.

        Args:
            alone: nothing else is in its input.
            where: begins messages.
        """
        if isinstance(source, Part):
            alone = alone and source.held is None
            return self._hidden(self._reads(source, alone, where), source, where)
        if isinstance(source, Goal):
            if "goal" not in self.own:
                raise PolicyError(
                    f"{where} is Goal(), but there is no goal: give goal=, numbers or a function "
                    "of observations; or goal_space, to a skill that is called with goals"
                )
            low, high = (None if x is None else np.array(x) for x in (source.low, source.high))
            return [Take("goal", self.own["goal"], low=low, high=high)]
        if isinstance(source, LastAction):
            return [Take("last_action", self.own["last_action"])]
        if isinstance(source, Elapsed):
            clock = Clock(np.atleast_1d(source.first), source.period, source.wave or "")
            return [Take("time", (clock.size,), time=clock)]
        if isinstance(source, Table):
            numbers = source.file.numbers
            if source.columns is not None:
                size = numbers.shape[1]
                numbers = numbers[:, places_in(source.columns, size, f"{where}.columns")]
            rows = Rows(numbers, source.rate, source.start)
            return [Take("time", (rows.size,), time=rows)]
        who = f"{where}, a function,"
        function = of_numbers(source.function, who)
        obs = made_up(self.space, 2)
        call = InCall(np.full(2, self.entry), obs, self.entry) if source.takes_call else None
        with examples(source.function):
            shape = numbers_of(function, obs, who, call=call).shape[1:]
        if len(shape) > 1 and not alone:
            raise PolicyError(
                f"{where}: a function beside other parts must return (n, numbers), not shape "
                f"{(2, *shape)}"
            )
        return [Take("function", shape, function=function, takes_call=source.takes_call, who=who)]

    def _reads(self, part: Part, alone: bool, where: str) -> list[Take]:
        """Return a ``Take`` of each leaf that a part reads, in the part's order."""
        from skillweave.spaces.observations import image_layout
        from skillweave.spaces.packing import leaf_spaces

        key = part.key
        names = {path: ".".join(path) for path in self.leaves}
        paths = [x for x, name in names.items() if not key or f"{name}.".startswith(f"{key}.")]
        if not paths and () in names:
            raise PolicyError(
                f"{where} reads {key!r}, but the observation is no Dict: it is {self.space}"
            )
        if not paths:
            raise PolicyError(
                f"{where} reads {key!r}, which the observation does not have"
                f"{suggest(key, names.values())}"
            )
        if len(paths) == 1 and part.places is None:
            shape = self.leaves[paths[0]].shape
            number = not part.one_hot and part.history == 1
            return [self._take(paths[0], part, alone and (len(shape) > 1 or number))]
        if len(paths) > 1:
            leaves = leaf_spaces(self.space)
            paths = [path for path in paths if image_layout(leaves[path]) is None]
        if not paths:
            raise PolicyError(f"{where} reads {key!r}, which has images alone: name one of them")
        takes = [self._take(path, part) for path in paths]
        first = np.cumsum([0, *(take.size for take in takes)])
        places = places_in(part.places, int(first[-1]), f"{where}.places")
        owner = np.searchsorted(first, places, side="right") - 1
        found: list[Take] = []
        for run in np.split(np.arange(len(places)), np.flatnonzero(np.diff(owner)) + 1):
            leaf = owner[run[0]]
            inner = tuple((places[run] - first[leaf]).tolist())
            found.append(replace(takes[leaf], places=inner))
        return found

    def _hidden(self, takes: list[Take], part: Part, where: str) -> list[Take]:
        """Return the ``Take`` of each leaf that a part reads, without the numbers that are held."""
        if part.held is None:
            return takes
        sizes = [take.size for take in takes]
        every = sizes
        if part.places is not None:
            every = [take.size for take in self._reads(replace(part, places=None), False, where)]
        own = places_in(part.places, sum(every), f"{where}.places")
        hidden = places_in(part.held, sum(every), f"{where}.held")
        held = np.isin(own, hidden)
        if not held.any():
            raise PolicyError(f"{where}.held names no number that the part reads")
        at = _wide(part.offset, len(own), f"{where}.offset").copy()
        if part.held_at is not None:
            values = _wide(part.held_at, len(hidden), f"{where}.held_at")
            shown = dict(zip(hidden.tolist(), values.tolist(), strict=True))
            at = np.array([shown.get(place, 0.0) for place in own.tolist()])
        ends = np.cumsum(sizes)[:-1]
        return [
            replace(take, held=tuple(np.flatnonzero(mine).tolist()), held_at=numbers[mine])
            if mine.any()
            else take
            for take, mine, numbers in zip(
                takes, np.split(held, ends), np.split(at, ends), strict=True
            )
        ]

    def _take(self, path: tuple[str, ...], part: Part, whole: bool = False) -> Take:
        """Return the ``Take`` of a whole leaf; choices are one-hot where the part says so."""
        leaf = self.leaves[path]
        choices: tuple[tuple[int, int], ...] = ()
        if part.one_hot and not whole and leaf.kind in ("Discrete", "MultiDiscrete"):
            first = np.broadcast_to(leaf.bounds[0], leaf.shape).reshape(-1).tolist()
            choices = tuple(zip(leaf.counts, first, strict=True))
        return Take("observation", leaf.shape, path, None, choices, whole)


def _scaling(parts: Sequence[tuple[Any, int, str]], shape: tuple[int, ...]) -> tuple[Affine, ...]:
    """Return the scaling of a mapping's input: settings, width and name of each part."""
    columns: list[Array | None] = []
    neutral = ("offset", 0.0), ("scale", 1.0), ("clip", -np.inf), ("clip", np.inf)
    for name, default in neutral:
        wide = []
        for settings, n, where in parts:
            value = getattr(settings, name)
            if name == "clip":
                value = default if value is None else value[default > 0]
            wide.append(_wide(value, n, f"{where}.{name}"))
        column = np.concatenate(wide).reshape(shape)
        columns.append(None if (column == default).all() else column)
    return () if all(x is None for x in columns) else (Affine(*columns),)


def _wide(value: float | tuple[float, ...], n: int, where: str) -> Array:
    """Return one number as n, or check that there are n."""
    if isinstance(value, tuple) and len(value) != n:
        raise PolicyError(f"{where} has {len(value)} numbers, but it scales {n}")
    return np.broadcast_to(np.array(value, np.float64), (n,))


def for_model(inputs: dict[str, Input], expected: Shapes, who: str) -> dict[str, Input]:
    """Return a mapping's inputs in the shapes that a model from elsewhere takes.

    Raises:
        PolicyError: one is not set, does not exist, or has another shape.
    """
    if not expected:
        return inputs
    if set(inputs) == {""} and len(expected) == 1:
        expected = {"": next(iter(expected.values()))}
    for name in expected:
        if name not in inputs:
            raise PolicyError(
                f"{who}: sees does not set the input {name!r}; the policy takes "
                f"{', '.join(expected)}: write sees={{{name!r}: ..., ...}}"
            )
    found: dict[str, Input] = {}
    for name, given in inputs.items():
        if name not in expected:
            raise PolicyError(
                f"{who}: sees has an input {name!r}, which the policy does not take"
                + suggest(name, expected)
            )
        wanted = expected[name]
        has = given.shape
        if fits_shape(has, wanted) or wanted is None:
            found[name] = given
            continue
        if wanted in ((), (1,)) and has in ((), (1,)):
            found[name] = replace(given, shape=(1,) * len(wanted), reshaped=True)
            continue
        known = [n for n in wanted if n is not None]
        numbers, size = prod(known), prod(has)
        if given.past is not None and len(known) == len(wanted) and numbers == size:
            found[name] = replace(given, shape=tuple(known), reshaped=True)  # (inferences, numbers)
            continue
        text = f"{who}: {_field(name)} gives {described(given)}"
        if len(known) < len(wanted) or numbers == size:
            shape = "(" + ", ".join("n" if x is None else str(x) for x in wanted) + ")"
            raise PolicyError(
                f"{text} of shape {has}, but the policy takes {shape}: let a function of "
                "observations give the input its shape"
            )
        lacks = f": {numbers - size} stay unset" if numbers > size else ""
        raise PolicyError(f"{text}, but the policy takes {numbers}{lacks}")
    return found


def places_in(
    places: slice | tuple[int, ...] | None, size: int, where: str, action: Space[Any] | None = None
) -> Array:
    """Return a declared mapping's places as an array; check that they are below ``size``.

    Args:
        where: begins the message.
        action: the space of the action that they are in; None: they are in an observation.
    """
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
        if action is None
        else f"{where} is {short(places)}, a part of the action that does not exist: "
        f"{short(action)} has places 0 to {size - 1}"
    )


# Outputs


def fitted_outputs(acts: Acts | None, space: Space[Any], who: str, logits: bool) -> Outputs:
    """Return the meaning of outputs by a declared ``acts``, for an action space.

    Raises:
        PolicyError: ``acts`` does not fit the space; the message begins with ``who``.
    """
    data = space_of(space)
    choice = data.kind == "Discrete"
    if acts is not None and not choice and data.kind != "Box":
        raise PolicyError(f"{who}: acts needs actions of a Box or a Discrete, not {space}")
    meaning = Outputs(data, logits=logits, who=who)
    if acts is None:
        return meaning
    if choice and not acts.plain:
        raise PolicyError(
            f"{who}: acts has scale, offset, clip, rest or ramp, but actions are choices of "
            f"{space}; only to applies there"
        )
    if choice and acts.to is None:
        return meaning
    size = sum(data.counts) if choice else prod(data.shape)
    to = tuple(places_in(acts.to, size, f"{who}: acts.to", space).tolist())
    if choice:
        return replace(meaning, to=to)
    left = size - len(to)
    if left and acts.rest is None:
        raise PolicyError(
            f"{who}: acts writes {len(to)} of {size} numbers of an action; give the others "
            "as Acts(..., rest=0.0)"
        )
    if not left and acts.rest is not None:
        raise PolicyError(f"{who}: acts has rest, but its outputs are all numbers of an action")
    scale, offset = (
        None if value == default else _wide(value, len(to), f"{who}: acts.{name}")
        for name, value, default in (("scale", acts.scale, 1.0), ("offset", acts.offset, 0.0))
    )
    rest = None
    if acts.rest is not None:
        rest = np.zeros(size)
        rest[np.setdiff1d(np.arange(size), to)] = _wide(acts.rest, left, f"{who}: acts.rest")
    return replace(meaning, to=to, scale=scale, offset=offset, clip=acts.clip, rest=rest)
