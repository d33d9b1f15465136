"""The mapping between an environment and a policy made elsewhere, as data.

It lists what the policy's inputs hold, what its outputs mean, and how often it acts. ``mapped``
applies it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, is_dataclass
from functools import partial
from itertools import count
from typing import Annotated, Any, Literal

import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.named import named
from skillweave.errors import DeclarationError
from skillweave.policies.mapped import LONGEST
from skillweave.policies.timed import LONGEST as LONGEST_PAST, MOST
from skillweave.schema import Check, Count, Positive, fitted, settings
from skillweave.skills.outputs import parameters_of
from skillweave.skills.tables import Recording, recorded, recording

# Values of fields


def floats(value: Any) -> float | tuple[float, ...]:
    """Return numbers of a declared setting as finite floats; else raise a ValueError."""
    array = np.asarray(value, np.float64)
    if isinstance(value, str | bool) or array.ndim > 1 or not array.size:
        raise ValueError
    if not np.isfinite(array).all():
        raise ValueError
    return tuple(array.tolist()) if array.ndim else float(array)


def _range(value: Any) -> tuple[float, float]:
    low, high = np.array(floats(value))
    if low > high:
        raise ValueError
    return float(low), float(high)


def _places(value: Any) -> slice | tuple[int, ...]:
    """Return places in a mapping, as a user or a file writes them: a slice or a tuple."""
    if isinstance(value, str):  # as files have slices
        value = slice(*(int(x) if x else None for x in value.split(":")))
    if isinstance(value, slice):
        bounds = (value.start, value.stop, value.step)
        if all(x is None or isinstance(x, int | np.integer) for x in bounds) and value.step != 0:
            return value
        raise ValueError
    places = np.atleast_1d(value)
    if places.dtype.kind not in "iu" or places.ndim > 1 or not places.size or places.min() < 0:
        raise ValueError
    return tuple(places.tolist())


def _goal(value: Any) -> Any:
    return value if callable(value) else tuple(np.atleast_1d(floats(value)).tolist())


Numbers = Annotated[Any, Check("a finite number, or a list of such", convert=floats)]
"""A number, or one for each of several."""
Range = Annotated[Any, Check("the lowest and the highest number: (-1.0, 1.0)", convert=_range)]
"""The lowest and the highest number."""
Anew = Literal["state", "last_action", "held", "elapsed", "history"]
"""What a policy remembers, and may begin anew in each call."""
Places = Annotated[Any, Check("a slice, or a list of places, counted from 0", convert=_places)]
"""A slice or a tuple of places."""
GoalValue = (
    Annotated[
        Any,
        Check(
            "finite numbers, or a function of observations that returns (n, numbers)",
            convert=_goal,
        ),
    ]
    | None
)
"""The goal of a policy."""
_Steps = Annotated[int, Check(f"at least 1 and at most {LONGEST:,}", lambda x: 1 <= x <= LONGEST)]
_Past = Annotated[
    int, Check(f"at least 1 and at most {LONGEST_PAST:,}", lambda x: 1 <= x <= LONGEST_PAST)
]


# Parts of an input


@settings
class Scaling:
    """A scaling of inputs: ``(number - offset) * scale``, then clipped."""

    _from_dict = True
    _: KW_ONLY
    scale: Numbers = 1.0
    """A factor, or one for each number."""
    offset: Numbers = 0.0
    """A number, or one for each, that is subtracted first: a mean, or a default pose."""
    clip: Range | None = None
    """The lowest and the highest number, after scaling."""


@settings
class WithPast(Scaling):
    """A scaling of inputs that may hold the numbers of a few inferences."""

    _: KW_ONLY
    history: _Past = 1
    """The policy takes the numbers of this many inferences, this one included."""
    fill: Literal["first", "zeros"] = "first"
    """What stands there before the first inference: its numbers, or zeros, which are not scaled."""
    layout: Literal["term", "step"] = "term"
    """"term": all inferences of this part, then the next part. "step": neighbouring parts that say
    so are joined, all parts of one inference, then those of the next."""
    order: Literal["oldest", "newest"] = "oldest"
    """The inference that stands first."""

    def __post_init__(self) -> None:
        given = (self.fill, self.layout, self.order) != ("first", "term", "oldest")
        if self.history == 1 and given:
            raise DeclarationError(
                f"{type(self).__name__} has fill, layout or order, but a history of 1: give "
                "history, too"
            )


@settings
class Part(WithPast):
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
    places: Places | None = None
    """Its numbers, counted from 0 in its flat form: a slice, or a list of places in the order in
    which the policy takes them. None: all."""
    _: KW_ONLY
    one_hot: bool = True
    """False: a choice stays one number."""
    held: Places | None = None
    """Places, counted as ``places`` are, that the policy is not shown, since others drive them: the
    arms, for a walk that is to believe that they hang still. None: none."""
    held_at: Numbers | None = None
    """What it is shown there instead, before offset and scale: a number, or one for each of
    ``held``. None: the offset, so the default pose."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.held_at is not None and self.held is None:
            raise DeclarationError("Part.held_at is given, but no places: give held, too")


@settings
class Goal(WithPast):
    """The place of the goal, a command for example, among the inputs of a policy.

    Its value is the ``goal=`` of the policy.

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """

    low: Numbers | None = None
    """The lowest goal, one number or one for each, for which the policy was made; None: any."""
    high: Numbers | None = None
    """The highest goal."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if None not in (self.low, self.high) and np.any(np.array(self.low) > self.high):
            raise DeclarationError(f"Goal.low is {short(self.low)}, which is more than Goal.high")


@settings
class LastAction(WithPast):
    """The place of the policy's last output among its inputs; zeros before the first.

    It is the output of the policy itself, after ``Acts.clip`` and before ``Acts.scale``.

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """


@settings
class Elapsed(Scaling):
    """A clock among the inputs of a policy: the steps since its skill took over.

    ```python
    import skillweave as sw

    step = sw.Elapsed(clip=(0, 299))
    phase = sw.Elapsed(period=40, wave="sin"), sw.Elapsed(period=40, wave="cos")
    feet = sw.Elapsed(period=50, first=(0, 25), wave="cos")
    ```

    It starts again after another skill's call, and goes on where the skill is called again at once,
    unless ``anew`` of its policy names "elapsed".

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """

    _: KW_ONLY
    period: Positive | None = None
    """The steps after which it starts again at 0; None: it counts on."""
    first: Numbers = 0.0
    """Its number at the first step; or several, of as many clocks."""
    wave: Literal["sin", "cos"] | None = None
    """The sine or cosine of 2π · number / period; None: the number itself, in steps."""

    def __post_init__(self) -> None:
        if self.wave is not None and self.period is None:
            raise DeclarationError(f"Elapsed.wave is {self.wave!r}: give period, too, in steps")


@settings
class Table(Scaling):
    """Rows of a table among the inputs of a policy: a reference motion, a row for each step.

    ```python
    import numpy as np
    import skillweave as sw

    motion = sw.Table(np.zeros((300, 7)), columns=slice(3, 7), rate=0.6, start=12)
    ```

    It starts after another skill's call, as ``Elapsed`` does. Its last row stays. Between two rows
    numbers are on the line between them, so quaternions should have one row for each step.

    Raises:
        DeclarationError: a setting is wrong; the message names it.
        RunError: the file cannot be read.
    """

    file: Any
    """A .csv file, perhaps with a line of names, or a .npy file, or an array: (rows, columns)."""
    columns: Places | None = None
    """Its columns, counted from 0, in the order in which the policy takes them; None: all."""
    _: KW_ONLY
    rate: Positive = 1.0
    """Rows for each step: 0.6 for 30 rows and 50 steps a second."""
    start: Annotated[float, Check("finite")] = 0.0
    """The row of the first step."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "file", recording(self.file))
        rows, columns = self.file.numbers.shape
        if not -MOST < self.start < rows:
            raise DeclarationError(f"Table.start is {self.start:g}, but the table has {rows} rows")
        if isinstance(self.columns, tuple) and max(self.columns) >= columns:
            raise DeclarationError(
                f"Table.columns is {short(self.columns)}, but the table has {columns} columns"
            )


@settings
class Computed(Scaling):
    """Numbers (n, K) that a function of the user makes of observations (n, *obs_shape)."""

    function: Callable[[Any], Any] | None = None
    """The function."""

    @property
    def takes_call(self) -> bool:
        """It has a parameter ``call``, for the time of the call."""
        return takes_call(self.function)


def takes_call(function: Any) -> bool:
    """Return whether a user's function has a parameter ``call``, which is not set already."""
    given = function.keywords if isinstance(function, partial) else {}
    return "call" not in given and any(
        p.name == "call" and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
        for p in parameters_of(function)
    )


Source = Part | Goal | LastAction | Elapsed | Table | Computed
KINDS: dict[str, type[Any]] = {
    "observation": Part,
    "goal": Goal,
    "last_action": LastAction,
    "elapsed": Elapsed,
    "table": Table,
    "function": Computed,
}
"""Kinds of sources, by their names in files."""


# Outputs


@settings
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

    _from_dict = True
    to: Places | None = None
    """The places of the outputs in the environment's action, in its flat form: a slice, or a list
    of places, one for each output. Of Discrete actions: the number, from 0, of each choice of the
    policy. None: all, in their order."""
    scale: Numbers = 1.0
    """A factor, or one for each output."""
    offset: Numbers = 0.0
    """A number, or one for each output, that is added last: a default pose."""
    clip: Range | None = None
    """The lowest and the highest output, before scaling."""
    rest: Numbers | None = None
    """The other numbers of the action, where ``to`` is a part of it: a number, or one for each."""
    ramp: Count = 0
    """The steps in which the action goes from the robot's last one to the policy's, in a call that
    follows another skill's; 0: none. The k-th of n steps has k/n of the policy's."""

    def __post_init__(self) -> None:
        if isinstance(self.to, tuple) and len(set(self.to)) != len(self.to):
            raise DeclarationError(
                f"Acts.to is {short(self.to)}; each place of an action can be written once"
            )

    @property
    def plain(self) -> bool:
        """Return whether outputs keep their values."""
        kept = self.scale == 1.0 and self.offset == 0.0 and self.clip is None
        return kept and self.rest is None and not self.ramp


# All of it


@dataclass(frozen=True)
class PolicyMapping:
    """The whole mapping of a policy.

    Raises:
        DeclarationError: the goal has no place or is out of its range, or a count is wrong.
    """

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
    """The recurrent state: of an ONNX file (input, output), perhaps with a first value; shapes with
    None as the axis of the environments; or names of a module's buffers."""
    single_state: bool = False
    """A module takes and returns one array as its state, not a tuple."""
    scaling: dict[str, Scaling] = field(default_factory=dict)
    """A last scaling of whole inputs: the statistics of ``VecNormalize``."""
    anew: tuple[str, ...] = ()
    """What begins anew in each call, also where the skill is called again at once."""
    entry: int = 0
    """The step at which its time starts, where the skill takes over."""

    def sources(self) -> list[Source]:
        """Return the parts of all inputs."""
        return [source for parts in (self.sees or {}).values() for source in parts]

    @property
    def timed(self) -> bool:
        """Return whether an input depends on the steps since the skill took over."""
        return any(
            isinstance(source, Elapsed | Table)
            or (isinstance(source, Computed) and source.takes_call)
            for source in self.sources()
        )

    @property
    def goal_places(self) -> list[Goal]:
        """Return the places of the goal among the inputs."""
        return [source for source in self.sources() if isinstance(source, Goal)]

    def __post_init__(self) -> None:
        kinds: dict[str, Any] = {
            "goal": GoalValue,
            "every": _Steps,
            "chunk": _Steps | None,
            "anew": tuple[Anew, ...],
            "entry": int,
        }
        for name, kind in kinds.items():
            object.__setattr__(self, name, fitted(kind, getattr(self, name), name))
        kept = {
            "state": bool(self.state),
            "last_action": any(isinstance(source, LastAction) for source in self.sources()),
            "held": self.every > 1 or self.chunk is not None,
            "elapsed": self.timed,
            "history": any(getattr(source, "history", 1) > 1 for source in self.sources()),
        }
        if idle := [name for name in self.anew if not kept[name]]:
            raise DeclarationError(
                f"anew names {idle[0]!r}, but the policy remembers none: it has no "
                "state=, no LastAction() in sees, no every= and chunk=, no Elapsed(), Table() or "
                "function with call in sees, or no history="
            )
        if self.entry and not self.timed:
            raise DeclarationError(
                f"entry is {self.entry}, but nothing in sees depends on time: no Elapsed(), no "
                "Table(), and no function with call"
            )
        for name, parts in (self.sees or {}).items():
            _check_layout(parts, f"sees[{name!r}]" if name else "sees")
        if callable(self.goal) and takes_call(self.goal):
            raise DeclarationError(
                f"goal is {function_name(self.goal)}, which takes call, and only functions in sees "
                "get it: write the function at the place of Goal() in sees"
            )
        if self.goal is not None and not self.goal_places:
            raise DeclarationError(
                "goal is given, but the policy does not take it: write Goal() at its place in sees"
            )
        if isinstance(self.goal, tuple):
            check_in_range(self.goal, self.goal_places)

    def functions(self) -> dict[str, Callable[[Any], Any]]:
        """Return the user's functions in it, by the names under which ``to_json`` has them."""
        found: list[Any] = [s.function for s in self.sources() if isinstance(s, Computed)]
        found += [self.goal] if callable(self.goal) else []
        named: dict[str, Callable[[Any], Any]] = {}
        for function in found:
            first = function_name(function)
            names = (first if i == 1 else f"{first}#{i}" for i in count(1))
            named[next(x for x in names if named.get(x, function) is function)] = function
        return named

    def tables(self) -> dict[str, Recording]:
        """Return its tables by their checksums, as ``to_json`` names them."""
        found = [source.file for source in self.sources() if isinstance(source, Table)]
        return {table.sha256: table for table in found}

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON; settings that have their defaults are left out."""
        names = {id(function): name for name, function in self.functions().items()}
        content: dict[str, Any] = to_json(self, names)
        return content

    @classmethod
    def from_json(
        cls,
        data: Any,
        code: Mapping[str, Callable[..., Any]] | None = None,
        tables: Mapping[str, Recording] | None = None,
    ) -> PolicyMapping:
        """Return the mapping that ``to_json`` wrote.

        Args:
            data: its JSON.
            code: the user's functions, by name.
            tables: its tables, by their checksums.

        Raises:
            DeclarationError: a field has a wrong value; the message names it.
        """
        beside = {**(tables or {}), **(code or {})}
        fitted(Mapping[str, Any], data, "the mapping")
        sees = fitted(dict[str, tuple[Any, ...]] | None, data.get("sees"), "sees")
        for name, parts in (sees or {}).items():
            where = f"sees[{name!r}]"
            sees[name] = tuple(_source(x, beside, f"{where}[{i}]") for i, x in enumerate(parts))
        goal = data.get("goal")
        if isinstance(goal, Mapping):
            goal = _function(goal.get("function"), beside, "goal")
        acts = fitted(Acts | None, data.get("acts"), "acts")
        scaling = fitted(dict[str, Scaling], data.get("scaling", {}), "scaling")
        state = fitted(tuple[tuple[Any, ...], ...], data.get("state", ()), "state")
        single = data.get("single_state", False)
        every = data.get("every", 1)
        chunk = data.get("chunk")
        anew = tuple(data.get("anew", ()))
        entry = data.get("entry", 0)
        return cls(sees, goal, acts, every, chunk, state, single, scaling, anew, entry)


def mapping_of(
    who: str,
    sees: Any = None,
    goal: Any = None,
    acts: Any = None,
    every: Any = 1,
    chunk: Any = None,
    state: Any = None,
    scaling: Mapping[str, Scaling] | None = None,
    anew: Any = (),
    entry: Any = 0,
) -> PolicyMapping:
    """Return the mapping that a user declares by arguments of ``from_onnx`` and its like.

    Args:
        who: the function, for messages: "from_onnx()".

    Raises:
        DeclarationError: an argument is wrong; the message names it.
    """
    try:
        states, single = _checked_state(state)
        parts = None if sees is None else checked_sees(sees)
        meaning = _checked_acts(acts)
        scalings = dict(scaling or {})
        anew = (anew,) if isinstance(anew, str) else anew
        how = every, chunk, states, single, scalings, anew, entry
        return PolicyMapping(parts, goal, meaning, *how)
    except DeclarationError as error:
        raise DeclarationError(f"{who}: {error}") from None


def function_name(function: Any) -> str:
    """Return the name of a function that a user declares, in files."""
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
    if of_skill and getattr(value, "history", 1) > 1:
        raise DeclarationError(f"{where} has history, {_NO_TIME}: leave it out")
    if isinstance(value, Source):
        return value
    if isinstance(value, type) and value in (Goal, LastAction, Part, Elapsed, Table):
        raise DeclarationError(f"{where} is the class {value.__name__}; write {value.__name__}()")
    if isinstance(value, str):
        return Part(value)
    if is_places(value):
        return Part(places=value)
    if callable(value):
        computed = Computed(function=value)
        if of_skill and computed.takes_call:
            raise DeclarationError(f"{where} takes call, {_NO_TIME}: leave it out")
        return computed
    others = "" if of_skill else "Goal(), LastAction(), Elapsed(), Table(...), "
    raise DeclarationError(
        f"{where} is {short(value)}; it must be the key of a part of the observation, a place in "
        f"it, a slice, Part(...), {others}or a function of observations"
    )


_NO_TIME = (
    "which only a policy from elsewhere has, in its own sees; a skill that learns sees "
    "observations alone, so let the environment observe it"
)
_NOT_OF_SKILLS: dict[type[Any], str] = {
    Goal: "but the policy of a skill with a goal_space sees the goal of its call already",
    LastAction: "which only a policy from elsewhere takes, in its own sees",
    Elapsed: _NO_TIME,
    Table: _NO_TIME,
}
"""Sources that a skill's ``sees`` cannot have, and why."""


def is_places(value: Any) -> bool:
    """Return whether a value in ``sees`` or ``acts`` is one place, or several."""
    if isinstance(value, slice | range | np.ndarray):
        return True
    return _is_whole(value) or (
        isinstance(value, list | tuple) and bool(value) and all(map(_is_whole, value))
    )


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def check_in_range(goal: tuple[float, ...], places: Sequence[Any]) -> None:
    """Raise a DeclarationError where a goal is out of the range of its places, ``Goal``."""
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
    """Return an entry of ``sees`` as sources: parts, goals, last actions, functions."""
    size = parts.size if isinstance(parts, np.ndarray) else None
    if size == 0 or (isinstance(parts, list | tuple | range) and not parts):
        raise DeclarationError(f"{where} is empty; name at least one part of the observation")
    if is_places(parts) or not isinstance(parts, list | tuple):
        return (as_source(parts, where, of_skill),)
    return tuple(as_source(part, f"{where}[{i}]", of_skill) for i, part in enumerate(parts))


def _check_layout(parts: Sequence[Source], where: str) -> None:
    """Raise a DeclarationError where parts with layout "step" are not joined into one block."""
    joined = [i for i, part in enumerate(parts) if getattr(part, "layout", "term") == "step"]
    if not joined:
        return
    several: list[Any] = [parts[i] for i in joined]
    alike = {(part.history, part.order) for part in several}
    if joined != list(range(joined[0], joined[-1] + 1)) or len(alike) > 1:
        raise DeclarationError(
            f'{where}: parts with layout="step" are joined, all parts of one inference, then those '
            "of the next: let them be neighbours, with the same history and the same order"
        )


def _checked_acts(acts: Any) -> Acts | None:
    """Return ``acts`` of a mapping as ``Acts``; None: not given."""
    if acts is None or isinstance(acts, Acts):
        return acts
    if is_places(acts) or isinstance(acts, list | tuple):
        return Acts(to=acts)
    raise DeclarationError(
        f"acts is {short(acts)}; it must be Acts(...), or the places of the outputs in the action"
    )


def _checked_state(state: Any) -> tuple[tuple[Any, ...], bool]:
    """Return the declared recurrent state of a policy, and True if it is one array."""
    if state is None:
        return (), False
    if (firsts := _first_values(state)) is not None:
        return firsts, False
    if isinstance(state, Mapping) and state:
        pairs = tuple(_checked_pair(name, after) for name, after in state.items())
        if all(pair is not None for pair in pairs):
            return pairs, False
    elif are_names(state):
        return tuple((name,) for name in ((state,) if isinstance(state, str) else state)), False
    elif isinstance(state, list | tuple) and state:
        single = not isinstance(state[0], list | tuple)
        shapes = (tuple(state),) if single else tuple(tuple(shape) for shape in state)
        sizes = [n for shape in shapes for n in shape if n is not None]
        one_axis = all(shape.count(None) == 1 for shape in shapes)
        if one_axis and all(_is_whole(n) and n >= 1 for n in sizes):
            return shapes, single
    raise DeclarationError(
        f"state is {short(state)}; it must be a shape with None as the axis of the environments, "
        "(None, 64), or a list of such shapes; of an ONNX file the name of the output that is the "
        "next state by the name of each input, {'h_in': 'h_out'}, perhaps with the value that it "
        "starts with, {'t': ('t_next', 1.0)}; of a module with buffers their names, or first "
        "values by name, {'phase': 1.0}"
    )


def _first_values(state: Any) -> tuple[tuple[str, Any], ...] | None:
    """Return names of a module's buffers with their first values; None: it is another state."""
    if not isinstance(state, Mapping) or not state:
        return None
    found = []
    for name, first in state.items():
        try:
            value = floats(np.asarray(first, np.float64).reshape(-1))
        except (TypeError, ValueError):
            return None
        if not isinstance(name, str) or isinstance(first, str | bool):
            return None
        found.append((name, value if np.ndim(first) else value[0]))  # type: ignore[index]
    return tuple(found)


def _checked_pair(name: Any, after: Any) -> tuple[Any, ...] | None:
    """Return an ONNX file's input of a state, its output, and perhaps its first value, or None."""
    if isinstance(name, str) and isinstance(after, str):
        return name, after
    if isinstance(name, str) and isinstance(after, list | tuple) and len(after) == 2:
        output, first = after
        try:
            numbers = floats(np.asarray(first, np.float64).reshape(-1))
        except (TypeError, ValueError):
            return None
        if isinstance(output, str) and isinstance(numbers, tuple):
            return name, output, numbers if np.ndim(first) else numbers[0]
    return None


def are_names(state: Any) -> bool:
    """Return whether a declared state is names of a module's buffers."""
    several = (state,) if isinstance(state, str) else state
    return (
        isinstance(several, list | tuple)
        and bool(several)
        and all(isinstance(name, str) and name for name in several)
    )


# Files


def to_json(value: Any, names: Mapping[int, str] | None = None) -> Any:
    """Return a declared mapping's settings as JSON; those with their defaults are left out.

    Args:
        value: a slice becomes a text, ``0:45``.
        names: of the user's functions in it, by ``id``; None: there are none.
    """
    if isinstance(value, slice):
        bounds = [value.start, value.stop, *([] if value.step is None else [value.step])]
        return ":".join("" if x is None else str(int(x)) for x in bounds)
    if isinstance(value, tuple | list):
        return [to_json(x, names) for x in value]
    if isinstance(value, Mapping):
        return {k: to_json(x, names) for k, x in value.items()}
    if isinstance(value, Recording):
        return value.to_json()
    if not is_dataclass(value):
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    kinds = [("source", name) for name, kind in KINDS.items() if isinstance(value, kind)]
    content: dict[str, Any] = dict(kinds)
    for entry in fields(value):
        setting = getattr(value, entry.name)
        if not isinstance(setting, Recording) and setting in (entry.default, {}):
            continue
        if callable(setting):
            name = (names or {})[id(setting)]
            content[entry.name] = {"function": name} if entry.name == "goal" else name
        else:
            content[entry.name] = to_json(setting, names)
    return content


def _source(data: Any, code: Mapping[str, Any], where: str) -> Source:
    """Return a source, of the one of ``KINDS`` that its field ``source`` names.

    Args:
        code: the user's functions by name, and tables by checksum.
    """
    name = data.get("source") if isinstance(data, Mapping) else None
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise DeclarationError(
            f"{where} is {short(data)}; its field source must be one of {', '.join(KINDS)}"
        )
    given = {k: x for k, x in data.items() if k != "source"}
    if kind is Computed:
        given["function"] = _function(given.get("function"), code, where)
    if kind is Table:
        given["file"] = recorded(given.get("file"), code, where)
    source: Source = fitted(kind, given, where)
    return source


def _function(name: Any, code: Mapping[str, Any], where: str) -> Callable[[Any], Any]:
    function = code.get(name) if isinstance(name, str) else None
    if not callable(function):
        raise DeclarationError(f"{where} needs the function {short(name)}: give it in code")
    return function  # type: ignore[no-any-return]
