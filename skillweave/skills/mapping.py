"""The mapping between an environment and a policy made elsewhere, as data.

It lists what the policy's inputs hold, what its outputs mean, and how often it acts. ``mapped``
applies it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np

from skillweave.arguments import checked_names, meant
from skillweave.errors import DeclarationError
from skillweave.messages import short, shortened
from skillweave.named import named

# Parts of an input


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """A scaling of inputs: ``(number - offset) * scale``, then clipped."""

    scale: Any = 1.0
    """A factor, or one for each number."""
    offset: Any = 0.0
    """A number, or one for each, that is subtracted first: a mean, or a default pose."""
    clip: Any = None
    """The lowest and the highest number, after scaling."""

    def __post_init__(self) -> None:
        _set(self, "scale", _numbers(self, "scale"))
        _set(self, "offset", _numbers(self, "offset"))
        _set(self, "clip", _range(self, "clip"))


@checked_names
@dataclass(frozen=True)
class Part(Scaling):
    """Numbers of the observation as inputs of a policy: ``(number - offset) * scale``, clipped.

    ```python
    import numpy as np
    import skillweave as sw

    HOME = np.array([0.1, 0.9, -1.8])
    angles = sw.Part("joints", slice(0, 3), offset=HOME, scale=0.5, clip=(-5, 5))
    ```

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """

    key: str = ""
    """The part of a Dict or Tuple observation, ``arm.joints`` for one within another; empty: the
    whole observation. Choices become one-hot, images count only where nothing else is in it."""
    places: Any = None
    """Its numbers, counted from 0 in its flat form: a slice, or a list of places in the order in
    which the policy takes them. None: all."""
    one_hot: bool = field(default=True, kw_only=True)
    """False: a choice stays one number."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.key, str):
            raise DeclarationError(
                f"Part.key is {short(self.key)}; it must be the name of a part of the observation"
            )
        _set(self, "places", _places(self, "places"))
        if not isinstance(self.one_hot, bool):
            raise DeclarationError(
                f"Part.one_hot is {short(self.one_hot)}; it must be True or False"
            )


@checked_names
@dataclass(frozen=True)
class Goal(Scaling):
    """The place of the goal, a command for example, among the inputs of a policy.

    Its value is the ``goal=`` of the policy.

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """

    low: Any = None
    """The lowest goal, one number or one for each, for which the policy was made; None: any."""
    high: Any = None
    """The highest goal."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("low", "high"):
            if getattr(self, name) is not None:
                _set(self, name, _numbers(self, name))
        if (
            self.low is not None
            and self.high is not None
            and np.any(np.array(self.low) > self.high)
        ):
            raise DeclarationError(f"Goal.low is {short(self.low)}, which is more than Goal.high")


@checked_names
@dataclass(frozen=True)
class LastAction(Scaling):
    """The place of the policy's last output among its inputs; zeros before the first.

    It is the output of the policy itself, after ``Acts.clip`` and before ``Acts.scale``.

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """


@dataclass(frozen=True)
class Computed(Scaling):
    """Numbers (n, K) that a function of the user makes of observations (n, *obs_shape)."""

    function: Callable[[Any], Any] | None = None
    """The function."""


Source = Part | Goal | LastAction | Computed
KINDS: dict[str, type[Any]] = {
    "observation": Part,
    "goal": Goal,
    "last_action": LastAction,
    "function": Computed,
}
"""Kinds of sources, by their names in files."""


# Outputs


@checked_names
@dataclass(frozen=True)
class Acts:
    """A policy's output as an action: clipped, then ``number * scale + offset``.

    Where actions are whole numbers of a Box, the result is rounded.

    ```python
    import skillweave as sw

    arm = sw.Acts(to=slice(0, 3), scale=0.05, rest=0.0)
    ```

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """

    to: Any = None
    """The places of the outputs in the environment's action, in its flat form: a slice, or a list
    of places, one for each output. Of Discrete actions: the number, from 0, of each choice of the
    policy. None: all, in their order."""
    scale: Any = 1.0
    """A factor, or one for each output."""
    offset: Any = 0.0
    """A number, or one for each output, that is added last: a default pose."""
    clip: Any = None
    """The lowest and the highest output, before scaling."""
    rest: Any = None
    """The other numbers of the action, where ``to`` is a part of it: a number, or one for each."""

    def __post_init__(self) -> None:
        _set(self, "to", _places(self, "to"))
        _set(self, "scale", _numbers(self, "scale"))
        _set(self, "offset", _numbers(self, "offset"))
        _set(self, "clip", _range(self, "clip"))
        if self.rest is not None:
            _set(self, "rest", _numbers(self, "rest"))
        if isinstance(self.to, tuple) and len(set(self.to)) != len(self.to):
            raise DeclarationError(
                f"Acts.to is {short(self.to)}; each place of an action can be written once"
            )

    @property
    def plain(self) -> bool:
        """Return whether outputs keep their values."""
        return self.scale == 1.0 and self.offset == 0.0 and self.clip is None and self.rest is None


# All of it


@dataclass(frozen=True)
class PolicyMapping:
    """The whole mapping of a policy."""

    sees: dict[str, tuple[Source, ...]] | None = None
    """The parts of each input, by its name; "": the only one. None: the whole observation."""
    goal: tuple[float, ...] | Callable[[Any], Any] | None = None
    """The goal: numbers, or a function of observations (n, *obs_shape) that returns (n, G)."""
    acts: Acts | None = None
    """The meaning of the outputs; None: they are the action."""
    every: int = 1
    """Each action is held for this number of steps."""
    chunk: int | None = None
    """The number of actions that are used of each inference; None: an inference is one action."""
    state: tuple[Any, ...] = ()
    """The recurrent state: pairs (input, output) of an ONNX file, or shapes with None as the axis
    of the environments."""
    single_state: bool = False
    """A module takes and returns one array as its state, not a tuple."""
    scaling: dict[str, Scaling] = field(default_factory=dict)
    """A last scaling of whole inputs: the statistics of ``VecNormalize``."""

    @property
    def is_identity(self) -> bool:
        """Return whether nothing is mapped: observations go in, actions come out."""
        return self == PolicyMapping()

    @property
    def period(self) -> int:
        """Return the number of steps from one inference to the next."""
        return self.every * (self.chunk or 1)

    @property
    def remembers_output(self) -> bool:
        """Return whether the last output is an input."""
        return any(isinstance(s, LastAction) for s in self.sources())

    def sources(self) -> list[Source]:
        """Return the parts of all inputs."""
        return [source for parts in (self.sees or {}).values() for source in parts]

    @property
    def takes_goal(self) -> bool:
        """Return whether the goal is among the inputs."""
        return any(isinstance(source, Goal) for source in self.sources())

    def check_goal(self) -> None:
        """Raise a DeclarationError where the goal has no place, or is out of its range."""
        places = [s for s in self.sources() if isinstance(s, Goal)]
        if self.goal is not None and not places:
            raise DeclarationError(
                "goal is given, but the policy does not take it: write Goal() at its place in sees"
            )
        if isinstance(self.goal, tuple):
            _check_in_range(self.goal, places)

    def functions(self) -> dict[str, Callable[[Any], Any]]:
        """Return the user's functions in it, by the names under which ``to_json`` has them."""
        found = [s.function for s in self.sources() if isinstance(s, Computed)]
        found += [self.goal] if callable(self.goal) else []
        named: dict[str, Callable[[Any], Any]] = {}
        for function in found:
            if function is not None and not any(function is other for other in named.values()):
                name = function_name(function)
                number = 2
                while name in named:
                    name = f"{function_name(function)}#{number}"
                    number += 1
                named[name] = function
        return named

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON; settings that have their defaults are left out."""
        names = {id(function): name for name, function in self.functions().items()}
        content: dict[str, Any] = {}
        if self.sees is not None:
            content["sees"] = {
                name: [source_to_json(part, names) for part in parts]
                for name, parts in self.sees.items()
            }
        if callable(self.goal):
            content["goal"] = {"function": names[id(self.goal)]}
        elif self.goal is not None:
            content["goal"] = list(self.goal)
        if self.acts is not None:
            content["acts"] = _to_json(self.acts)
        content |= {"every": self.every} if self.every != 1 else {}
        content |= {"chunk": self.chunk} if self.chunk is not None else {}
        if self.state:
            content["state"] = [list(entry) for entry in self.state]
            content |= {"single_state": True} if self.single_state else {}
        if self.scaling:
            content["scaling"] = {k: _to_json(v) for k, v in self.scaling.items()}
        return content

    @classmethod
    def from_json(
        cls, data: Any, code: Mapping[str, Callable[..., Any]] | None = None
    ) -> PolicyMapping:
        """Return the mapping that ``to_json`` wrote.

        Args:
            data: its JSON; further fields are ignored, unless one is like a field's name.
            code: the user's functions, by name.

        Raises:
            DeclarationError: a field has a wrong value; the message names it.
        """
        if not isinstance(data, Mapping):
            raise DeclarationError(f"the mapping is {short(data)}; it must be an object")
        _check_names(cls, data, "")
        code = code or {}
        sees = data.get("sees")
        goal = data.get("goal")
        for name in ("sees", "scaling"):
            if not isinstance(value := data.get(name), Mapping | None):
                raise DeclarationError(f"{name} is {short(value)}; it must be an object of inputs")
        if isinstance(goal, Mapping):
            goal = _function(goal.get("function"), code, "goal")
        acts = data.get("acts")
        scaling = data.get("scaling") or {}
        mapping = cls(
            sees=None
            if sees is None
            else {
                name: tuple(
                    _source_from_json(p, code, f"sees[{name!r}][{i}]")
                    for i, p in enumerate(_list(parts, f"sees[{name!r}]"))
                )
                for name, parts in sees.items()
            },
            goal=checked_goal(goal),
            acts=None if acts is None else _from_json(Acts, acts, "acts"),
            every=checked_count(data.get("every", 1), "every"),
            chunk=None if data.get("chunk") is None else checked_count(data["chunk"], "chunk"),
            state=tuple(
                tuple(_list(entry, "state")) for entry in _list(data.get("state", []), "state")
            ),
            single_state=data.get("single_state") is True,
            scaling={k: _from_json(Scaling, v, f"scaling[{k!r}]") for k, v in scaling.items()},
        )
        mapping.check_goal()
        return mapping


def mapping_of(
    who: str,
    *,
    sees: Any = None,
    goal: Any = None,
    acts: Any = None,
    every: Any = 1,
    chunk: Any = None,
    state: Any = None,
    scaling: Mapping[str, Scaling] | None = None,
) -> PolicyMapping:
    """Return the mapping that a user declares by arguments of ``from_onnx`` and its like.

    Args:
        who: the function, for messages: "from_onnx()".

    Raises:
        DeclarationError: an argument is wrong; the message names it.
    """
    try:
        states, single = _checked_state(state)
        mapping = PolicyMapping(
            sees=None if sees is None else checked_sees(sees),
            goal=checked_goal(goal),
            acts=_checked_acts(acts),
            every=checked_count(every, "every"),
            chunk=None if chunk is None else checked_count(chunk, "chunk"),
            state=states,
            single_state=single,
            scaling=dict(scaling or {}),
        )
        mapping.check_goal()
    except DeclarationError as error:
        raise DeclarationError(f"{who}: {error}") from None
    return mapping


def function_name(function: Any) -> str:
    """Return the name of a user's function in files."""
    try:
        return str(named(function, "a function"))
    except DeclarationError:  # a method of an object, for example
        return str(getattr(function, "__qualname__", type(function).__qualname__))


def as_source(value: Any, where: str, of_skill: bool = False) -> Source:
    """Return one entry of ``sees`` as a source.

    Args:
        value: the entry.
        where: begins messages.
        of_skill: it is of a skill's ``sees``, which has neither ``Goal`` nor ``LastAction``.

    Raises:
        DeclarationError: it is none.
    """
    kind = value if isinstance(value, type) else type(value)
    if of_skill and (why := _NOT_OF_SKILLS.get(kind)):
        raise DeclarationError(f"{where} has {kind.__name__}(), {why}: leave it out")
    if isinstance(value, Part | Goal | LastAction | Computed):
        return value
    if isinstance(value, type) and value in (Goal, LastAction, Part):
        raise DeclarationError(f"{where} is the class {value.__name__}; write {value.__name__}()")
    if isinstance(value, str):
        return Part(value)
    if is_places(value):
        return Part(places=value)
    if callable(value):
        return Computed(function=value)
    others = "" if of_skill else "Goal(), LastAction(), "
    raise DeclarationError(
        f"{where} is {short(value)}; it must be the key of a part of the observation, a place in "
        f"it, a slice, Part(...), {others}or a function of observations"
    )


_NOT_OF_SKILLS: dict[type[Any], str] = {
    Goal: "but the policy of a skill with a goal_space sees the goal of its call already",
    LastAction: "which only a policy from elsewhere takes, in its own sees",
}
"""Sources that a skill's ``sees`` cannot have, and why."""


def is_places(value: Any) -> bool:
    """Return whether a value is one place, or several: a slice, a range, a list or an array."""
    if isinstance(value, slice | range | np.ndarray):
        return True
    return _is_whole(value) or (
        isinstance(value, list | tuple) and bool(value) and all(map(_is_whole, value))
    )


def checked_count(value: Any, name: str) -> int:
    """Return a whole number of at least 1; a DeclarationError names it where it is none."""
    whole = isinstance(value, int | np.integer) and value is not True
    if not whole or not 1 <= value <= 10**5:  # all actions of a chunk are stored
        raise DeclarationError(
            f"{name} is {short(value)}; it must be a whole number, at least 1 and at most 100,000"
        )
    return int(value)


def checked_goal(goal: Any) -> Any:
    """Return a goal as a function or a tuple of numbers; None: there is none.

    Raises:
        DeclarationError: it is neither.
    """
    if goal is None or callable(goal):
        return goal
    values = _floats(goal)
    if values is None:
        raise DeclarationError(
            f"goal is {short(goal)}; it must be finite numbers, or a function of observations that "
            "returns (n, numbers)"
        )
    return values if isinstance(values, tuple) else (values,)


def _check_in_range(goal: tuple[float, ...], places: Sequence[Goal]) -> None:
    for place in places:
        for name, wrong in (("low", np.less), ("high", np.greater)):
            bound = getattr(place, name)
            if isinstance(bound, tuple) and len(bound) != len(goal):
                raise DeclarationError(
                    f"goal has {len(goal)} numbers, but Goal.{name} has {len(bound)}"
                )
            if bound is not None and wrong(goal, bound).any():
                raise DeclarationError(
                    f"goal is {goal}, out of the range for which the policy was made: Goal.{name} "
                    f"is {bound}"
                )


def checked_sees(sees: Any, of_skill: bool = False) -> dict[str, tuple[Source, ...]]:
    """Return ``sees`` by the names of inputs; ``of_skill``: it is a skill's.

    Raises:
        DeclarationError: an entry is wrong; the message names it.
    """
    if not isinstance(sees, Mapping):
        return {"": _checked_parts(sees, "sees", of_skill)}
    if not sees or not all(isinstance(name, str) and name for name in sees):
        raise DeclarationError("sees is a dict; its keys must be the names of the policy's inputs")
    return {
        name: _checked_parts(parts, f"sees[{name!r}]", of_skill) for name, parts in sees.items()
    }


def _checked_parts(parts: Any, where: str, of_skill: bool) -> tuple[Source, ...]:
    size = parts.size if isinstance(parts, np.ndarray) else None
    if size == 0 or (isinstance(parts, list | tuple | range) and not parts):
        raise DeclarationError(f"{where} is empty; name at least one part of the observation")
    if is_places(parts) or not isinstance(parts, list | tuple):
        return (as_source(parts, where, of_skill),)
    return tuple(as_source(part, f"{where}[{i}]", of_skill) for i, part in enumerate(parts))


def _checked_acts(acts: Any) -> Acts | None:
    if acts is None or isinstance(acts, Acts):
        return acts
    if is_places(acts) or isinstance(acts, list | tuple):
        return Acts(to=acts)
    raise DeclarationError(
        f"acts is {short(acts)}; it must be Acts(...), or the places of the outputs in the action"
    )


def _checked_state(state: Any) -> tuple[tuple[Any, ...], bool]:
    """Return the entries of the recurrent state, and True if it is one array."""
    if state is None:
        return (), False
    if isinstance(state, Mapping) and state:
        if all(isinstance(x, str) for pair in state.items() for x in pair):
            return tuple(state.items()), False
    elif isinstance(state, list | tuple) and state:
        single = not isinstance(state[0], list | tuple)
        shapes = (tuple(state),) if single else tuple(tuple(shape) for shape in state)
        if all(_is_shape(shape) for shape in shapes):
            return shapes, single
    raise DeclarationError(
        f"state is {short(state)}; it must be a shape with None as the axis of the environments, "
        "(None, 64), or a list of such shapes; of an ONNX file the name of the output that is the "
        "next state by the name of each input: {'h_in': 'h_out'}"
    )


def _is_shape(shape: tuple[Any, ...]) -> bool:
    sizes = [n for n in shape if n is not None]
    return len(sizes) == len(shape) - 1 and all(
        isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 1 for n in sizes
    )


# Values of fields


def _set(settings: Any, name: str, value: Any) -> None:
    object.__setattr__(settings, name, value)


def _floats(value: Any) -> float | tuple[float, ...] | None:
    """Return finite numbers as a float, or a tuple of such; None: they are none."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return None
    if isinstance(value, str | bool) or array.ndim > 1 or not array.size:
        return None
    if not np.isfinite(array).all():
        return None
    return tuple(array.tolist()) if array.ndim else float(array)


def _numbers(settings: Any, name: str) -> float | tuple[float, ...]:
    value = _floats(getattr(settings, name))
    if value is None:
        raise DeclarationError(
            f"{type(settings).__name__}.{name} is {short(getattr(settings, name))}; it must be a "
            "finite number, or a list of such"
        )
    return value


def _range(settings: Any, name: str) -> tuple[float, float] | None:
    value = getattr(settings, name)
    if value is None:
        return None
    found = _floats(value)
    if not isinstance(found, tuple) or len(found) != 2 or found[0] > found[1]:
        raise DeclarationError(
            f"{type(settings).__name__}.{name} is {short(value)}; it must be the lowest and the "
            "highest number: (-1.0, 1.0)"
        )
    return found[0], found[1]


def _places(settings: Any, name: str) -> slice | tuple[int, ...] | None:
    value = getattr(settings, name)
    if value is None:
        return None
    where = f"{type(settings).__name__}.{name} is {short(value)}"
    if isinstance(value, str):  # as files have slices
        value = _slice_of(value)
    if isinstance(value, slice):
        bounds = (value.start, value.stop, value.step)
        if all(x is None or isinstance(x, int | np.integer) for x in bounds) and value.step != 0:
            return value
    elif _is_place(value):
        return (int(value),)
    elif isinstance(value, range | list | tuple | np.ndarray):
        places = list(np.atleast_1d(value)) if isinstance(value, np.ndarray) else list(value)
        if places and all(_is_place(x) for x in places):
            return tuple(int(x) for x in places)
    raise DeclarationError(f"{where}; it must be a slice, or a list of places, counted from 0")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_place(value: Any) -> bool:
    return _is_whole(value) and int(value) >= 0


# Files


def places_to_json(places: slice | tuple[int, ...] | None) -> Any:
    """Return places as JSON: a slice as text, ``0:45``."""
    if not isinstance(places, slice):
        return None if places is None else list(places)
    bounds = [places.start, places.stop, *([] if places.step is None else [places.step])]
    return ":".join("" if x is None else str(int(x)) for x in bounds)


def _slice_of(text: str) -> slice | None:
    """Return the slice that ``places_to_json`` wrote; None: it is no slice."""
    bounds = text.split(":")
    try:
        values = [int(x) if x else None for x in bounds]
    except ValueError:
        return None
    return slice(*values) if len(bounds) in (2, 3) else None


def source_to_json(source: Source, names: Mapping[int, str]) -> dict[str, Any]:
    """Return a source as JSON; settings that have their defaults are left out.

    Args:
        source: the source.
        names: of the user's functions, by ``id``.
    """
    kind = next(name for name, kind in KINDS.items() if isinstance(source, kind))
    content = {"source": kind, **_to_json(source)}
    if isinstance(source, Computed):
        content["function"] = names[id(source.function)]
    return content


def _to_json(settings: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        if entry.default is not MISSING and value == entry.default:
            continue
        if callable(value):
            continue
        if entry.name in ("places", "to"):
            value = places_to_json(value)
        content[entry.name] = list(value) if isinstance(value, tuple) else value
    return content


def _source_from_json(data: Any, code: Mapping[str, Any], where: str) -> Source:
    kind = data.get("source") if isinstance(data, Mapping) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise DeclarationError(
            f"{where} is {short(data)}; its field source must be one of {', '.join(KINDS)}"
        )
    if KINDS[kind] is Computed:
        data = {**data, "function": _function(data.get("function"), code, where)}
    source: Source = _from_json(KINDS[kind], data, where)
    return source


def _from_json(kind: type[Any], data: Any, where: str) -> Any:
    """Return settings of a kind; see ``_check_names`` for further fields."""
    if not isinstance(data, Mapping):
        raise DeclarationError(f"{where} is {short(data)}; it must be an object")
    _check_names(kind, data, where)
    try:
        return kind(**{f.name: data[f.name] for f in fields(kind) if f.name in data})
    except DeclarationError as error:
        raise DeclarationError(f"{where}: {error}") from None


OTHER_FIELDS = (
    *("source", "function", "fields", "choices", "whole"),
    *("kind", "file", "code", "output", "outputs", "shapes", "logits", "sampled", "with_goal"),
)
"""Fields that a file has beside those of a mapping and its parts."""


def _check_names(kind: type[Any], data: Mapping[str, Any], where: str) -> None:
    """Raise a DeclarationError where an unknown field looks like a misspelt one."""
    known = [f.name for f in fields(kind)]
    for name in data:
        if name not in (*known, *OTHER_FIELDS) and (hint := meant(str(name), known, "")):
            place = f"{where}." if where else ""
            raise DeclarationError(f"{place}{shortened(str(name), 80)} is unknown{hint}")


def _function(name: Any, code: Mapping[str, Any], where: str) -> Callable[[Any], Any]:
    function = code.get(name) if isinstance(name, str) else None
    if not callable(function):
        raise DeclarationError(f"{where} needs the function {short(name)}: give it in code")
    return function  # type: ignore[no-any-return]


def _list(value: Any, where: str) -> Sequence[Any]:
    if not isinstance(value, list | tuple):
        raise DeclarationError(f"{where} is {short(value)}; it must be a list")
    return value


__all__ = [
    "Acts",
    "Computed",
    "Goal",
    "LastAction",
    "Part",
    "PolicyMapping",
    "Source",
    "mapping_of",
]
