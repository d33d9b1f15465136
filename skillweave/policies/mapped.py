"""Models from elsewhere as policies: what their inputs hold, and what their outputs mean."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import prod
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from .acting_errors import PolicyError
from .core import Array, InCall, Memory, RowPolicy, Turn, World, code, read_only
from .sessions import open_session
from .spaces import Space, at, discrete
from .timed import Clock, Past, Rows

Shapes = Mapping[str, tuple[int | None, ...] | None]
"""Shapes of a model's inputs for one environment, by name; None: unknown."""
HERE = {"written": False}
"""Metadata of fields that serve messages; files do not contain them."""
ANEW = {
    "state": "state",
    "last_action": "last",
    "held": "phase",
    "elapsed": "elapsed",
    "history": "past",
}
"""What may begin anew in each call, and its name in the memory."""
UNKNOWN = -1
"""In place of the steps that are left of a ramp: it is not known yet whether there is one."""
LONGEST = 100_000
"""The most steps of an action, and the most actions of an inference: all are remembered."""
NUMBERS: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(int16)": np.int16,
    "tensor(int8)": np.int8,
    "tensor(uint16)": np.uint16,
    "tensor(uint8)": np.uint8,
}
"""Supported types of an input, by ONNX's names."""


# Inputs -----------------------------------------------------------------------------------------


@dataclass(eq=False)
class Take:
    """Numbers that an acting policy takes from one source, for an input of its model.

    Raises:
        PolicyError: its fields contradict each other.
    """

    source: Literal["observation", "goal", "last_action", "function", "time"]
    shape: tuple[int, ...]
    """The shape for one environment, of the leaf, the goal, the last output, the function's
    result, or the clock or table."""
    fields: tuple[str, ...] = ()
    """The names that lead to a leaf of the observation."""
    places: tuple[int, ...] | None = None
    """Indices into the flat leaf, choices one-hot; None: all."""
    choices: tuple[tuple[int, int], ...] = ()
    """The number of options of each choice and its first one, where a leaf becomes one-hot."""
    whole: bool = False
    """It keeps its shape."""
    function: Callable[..., Any] | None = code(
        "observations (n, ...) to numbers (n, ...)", needed=False
    )
    low: Array | None = None
    """The lowest goal: one number, or one for each; None: any."""
    high: Array | None = None
    """The highest goal."""
    held: tuple[int, ...] = ()
    """Places among its numbers that it does not read: others drive them."""
    held_at: Array | None = None
    """(len(held),) what stands there."""
    takes_call: bool = False
    """The function has an argument ``call``."""
    time: Clock | Rows | None = None
    """The clock or the table that it reads."""
    who: str = field(default="a function", metadata=HERE)
    """Begins messages."""

    def __post_init__(self) -> None:
        if (self.function is None) == (self.source == "function"):
            raise PolicyError(
                f"Take.function is {self.function}, but Take.source is {self.source!r}"
            )
        if self.choices and (
            len(self.choices) != prod(self.shape) or min(n for n, _ in self.choices) < 1
        ):
            raise PolicyError(
                f"Take.choices is {self.choices}, which does not fit Take.shape {self.shape}"
            )
        numbers = sum(n for n, _ in self.choices) or prod(self.shape)
        self.size = numbers if self.places is None else len(self.places)
        """The number of its numbers for one environment."""
        self._places: Any = None
        if self.places is not None:
            check_places(self.places, numbers, "Take.places")
            first = self.places[0]
            end = self.places[0] + self.size
            follow = self.places == tuple(range(first, end))  # then they are read without a copy
            self._places = slice(first, end) if follow else np.array(self.places)
        if self.whole and (self.choices or self.places is not None):
            raise PolicyError("Take.whole is true, but Take.choices or Take.places are given")
        _check_sizes(self, (self.size,), "low", "high")
        if self.held:
            check_places(self.held, self.size, "Take.held", once=True)
        known = np.zeros(0) if self.held_at is None else self.held_at
        if np.shape(known) != (len(self.held),) or (self.held and self.whole):
            raise PolicyError(f"Take.held_at is {self.held_at} for Take.held {self.held}")
        self._held = np.array(self.held, np.int64)
        if self.source in ("goal", "last_action") and len(self.shape) != 1:
            raise PolicyError(f"Take.shape is {self.shape}, but a {self.source} is (numbers,)")
        size = None if self.time is None else (self.time.size,)
        if size != (self.shape if self.source == "time" else None):
            raise PolicyError(f"Take.time is {self.time}, but Take.source is {self.source!r}")
        if self.takes_call and self.function is None:
            raise PolicyError("Take.takes_call is true, but there is no Take.function")

    @property
    def name(self) -> str:
        """The name of its source in messages."""
        if self.source == "observation":
            return ".".join(self.fields) or "the observation"
        if self.source == "time":
            return "Elapsed()" if isinstance(self.time, Clock) else "Table()"
        return {"goal": "Goal()", "last_action": "LastAction()"}.get(self.source, "a function")

    @property
    def timed(self) -> bool:
        """It depends on the steps since the policy took over."""
        return self.source == "time" or self.takes_call

    def __call__(
        self, obs: Array, goal: Array | None, last: Array | None, call: InCall | None
    ) -> Array:
        """Return numbers (n, size), or (n, *shape) where it is whole or a function.

        Args:
            obs: (n, …).
            goal: (n, G), where it is taken.
            last: (n, K), the last outputs, where they are taken.
            call: the time since the policy took over, where it counts.
        """
        if self.function is not None:
            call = call if self.takes_call else None
            return numbers_of(self.function, obs, self.who, self.shape, call)
        if self.time is not None:
            assert call is not None
            return self.time(call.steps)
        if self.source == "last_action":
            assert last is not None
            return last
        if self.source == "goal":
            assert goal is not None
            return clipped(goal, self.low, self.high)
        found = at(obs, self.fields)
        if self.whole:
            return found
        if self.choices:
            flat = found.reshape(len(found), -1)
            hot = [_one_hot(flat[:, i] - k, n) for i, (n, k) in enumerate(self.choices)]
            found = hot[0] if len(hot) == 1 else np.concatenate(hot, axis=1)
        elif found.ndim != 2:
            found = found.reshape(len(found), -1)
        found = found if self._places is None else found[:, self._places]
        if self.held:
            found = found.astype(np.float64)  # so that a default pose is met to the last bit
            found[:, self._held] = self.held_at
        return found


def _one_hot(choice: Array, count: int) -> Array:
    """Return numbers (n, count): 1 at each choice (n,), else 0."""
    hot = np.zeros((len(choice), count))
    hot[np.arange(len(choice)), choice] = 1.0
    return hot


def numbers_of(
    function: Callable[..., Any],
    obs: Array,
    who: str,
    shape: tuple[int, ...] | None = None,
    call: InCall | None = None,
) -> Array:
    """Return the numbers (n, ...) that a function makes for a model as it acts; (n,) as (n, 1).

    Args:
        call: given to the function, too; None: it does not take it.

    Raises:
        PolicyError: it returned something else, or another ``shape`` of one environment.
    """
    named = {} if call is None else {"call": call}
    values = np.asarray(function(read_only(obs), **named))
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


@dataclass(eq=False)
class Affine:
    """A scaling of an acting model's input, ``(x - offset) * scale``, clipped; None: not."""

    offset: Array | None = None
    scale: Array | None = None
    low: Array | None = None
    high: Array | None = None

    def __call__(self, x: Array) -> Array:
        """Return scaled numbers (n, …)."""
        if self.offset is not None:
            x = x - self.offset
        if self.scale is not None:
            x = x * self.scale
        return clipped(x, self.low, self.high)


@dataclass(eq=False)
class Input:
    """One input of a model that acts, joined of what is taken.

    Raises:
        PolicyError: its fields contradict each other.
    """

    takes: tuple[Take, ...]
    shape: tuple[int, ...]
    """The shape of the input for one environment."""
    scalings: tuple[Affine, ...] = ()
    """Scalings of what is taken, applied in this order."""
    reshaped: bool = False
    """It is brought to its shape: one number with or without an axis of its own."""
    past: Past | None = None
    """Its numbers are of this inference and of some before; None: of this one alone."""
    last_scaling: Affine | None = None
    """A scaling of the input with its past."""

    def __post_init__(self) -> None:
        taken = sum(take.size for take in self.takes)
        size = taken if self.past is None else len(self.past.ages)
        if not self.takes or size != prod(self.shape):
            raise PolicyError(f"Input.shape is {self.shape}, but Input.takes gives {size} numbers")
        if self.past is not None and self.past.width != taken:
            raise PolicyError(f"Past.width is {self.past.width}, but Input.takes gives {taken}")
        shape = self.shape if self.past is None else (taken,)
        for one in self.scalings:
            _check_sizes(one, shape, "offset", "scale", "low", "high")
        if self.last_scaling is not None:
            _check_sizes(self.last_scaling, (size,), "offset", "scale", "low", "high")

    def __call__(self, obs: Array) -> Array:
        """Return the input (n, *shape) for observations (n, …), where it takes nothing else."""
        return self.shaped(self.now(obs))

    def now(
        self,
        obs: Array,
        goal: Array | None = None,
        last: Array | None = None,
        call: InCall | None = None,
    ) -> Array:
        """Return what is taken for this inference, (n, …); see ``Take``."""
        values = [take(obs, goal, last, call) for take in self.takes]
        x = values[0] if len(values) == 1 else np.concatenate(values, axis=1)
        for scaling in self.scalings:
            x = scaling(x)
        return x

    def shaped(self, x: Array) -> Array:
        """Return the input (n, *shape) of its numbers, those of its past included."""
        if self.last_scaling is not None:
            x = self.last_scaling(x)
        return x.reshape(len(x), *self.shape) if self.reshaped else x

    def check(self, sees: Space, where: str) -> None:
        """Raise a PolicyError where observations do not have what it takes.

        Args:
            sees: of the observations.
            where: begins the message.
        """
        for take in self.takes:
            leaf = sees.leaves.get(take.fields)
            if take.source == "observation" and (leaf is None or leaf.shape != take.shape):
                raise PolicyError(
                    f"{where} takes {take.name} of shape {take.shape}, but observations "
                    f"are of {sees}"
                )


def mixed(action: Array, other: Array, share: Array, rows: Array) -> Array:
    """Return real actions (k, …), in some rows mixed with others.

    Args:
        other: (m, …), of these rows.
        share: (m,) of ``action`` in the mixture.
        rows: (m,).
    """
    if not len(rows):
        return action
    found = action.copy()
    share = share.reshape(-1, *(1,) * (action.ndim - 1))
    both = share * action[rows] + (1.0 - share) * other
    found[rows] = np.rint(both) if action.dtype.kind in "iu" else both
    return found


def clipped(x: Array, low: Array | float | None, high: Array | float | None) -> Array:
    """Return numbers (n, …) between two others; None: any."""
    if low is not None:
        x = np.maximum(x, low)
    return x if high is None else np.minimum(x, high)


def _check_sizes(one: Any, shape: tuple[int, ...], *names: str) -> None:
    """Raise a PolicyError where a scaling of an acting model is not one number, or of a shape."""
    for name in names:
        x = getattr(one, name)
        if x is not None and np.shape(x) not in ((), (1,), shape):
            where = f"{type(one).__name__}.{name}"
            raise PolicyError(f"{where} has the shape {np.shape(x)}, but it is for {shape}")


def check_places(places: tuple[int, ...], size: int, name: str, *, once: bool = False) -> None:
    """Raise a PolicyError where a policy's field names places beyond ``size``, or one twice."""
    within = bool(places) and 0 <= min(places) <= max(places) < size
    if not within or (once and len(set(places)) < len(places)):
        raise PolicyError(
            f"{name} is {str(places)[:100]}; it must be places from 0 to {size - 1}"
            + ", each one once" * once
        )


# Outputs ----------------------------------------------------------------------------------------


@dataclass(eq=False)
class Outputs:
    """The meaning of an acting model's outputs, as actions of a space.

    Raises:
        PolicyError: its fields contradict each other.
    """

    space: Space
    to: tuple[int, ...] | None = None
    """The places of the outputs in the flat action; of one choice, the number, from 0, of each
    choice of the model. None: outputs are actions, and no other field changes them."""
    scale: Array | None = None
    """A factor of each output."""
    offset: Array | None = None
    """It is added to each scaled output."""
    clip: tuple[float, float] | None = None
    """The lowest and the highest output, before scaling."""
    rest: Array | None = None
    """(size,) the other numbers of the action; those at ``to`` do not count."""
    logits: bool = False
    """Outputs that are no whole numbers are logits of choices."""
    who: str = field(default="the policy", metadata=HERE)
    """Begins messages."""

    def __post_init__(self) -> None:
        space = self.space
        if self.logits and space.parts is not None:
            raise PolicyError(
                f"{self.who} is a network, whose one output cannot be read as actions of "
                f"{str(space)[:300]}: call it in a function that returns a dict or tuple of "
                "arrays, or let its skill write one part alone (acts)"
            )
        box = space.kind == "Box"
        self._bounds: tuple[Array | None, Array | None] = (None, None)
        if box:
            low, high = space.bounds
            self._bounds = (
                None if (low == -np.inf).all() else low,
                None if (high == np.inf).all() else high,
            )
        size = prod(space.shape) if box else sum(space.counts)
        self.count = size if box else 0
        """The number of outputs that are numbers of an action."""
        self.choices = [] if box or space.kind == "MultiBinary" else space.counts
        """The numbers of logits of each choice; []: there are none, or one for each bit."""
        self._rest: Array | None = None
        self._to: Any = None
        if self.to is None:
            return
        if not box and space.kind != "Discrete":
            raise PolicyError(f"Outputs.to needs actions of a Box or a Discrete, not {space}")
        check_places(self.to, size, "Outputs.to", once=True)
        self.count = len(self.to)
        self._to = np.array(self.to)
        if not box:
            self._chosen = discrete(self.count)
            self.choices = [self.count]
            return
        _check_sizes(self, (self.count,), "scale", "offset")
        if self.clip is not None and not self.clip[0] <= self.clip[1]:
            raise PolicyError(f"Outputs.clip is {self.clip}: its second number is the highest")
        if self.rest is not None and np.shape(self.rest) != (size,):
            raise PolicyError(f"Outputs.rest has the shape {np.shape(self.rest)}, not {(size,)}")
        if self.count < size and self.rest is None:
            raise PolicyError(
                f"Outputs.to writes {self.count} of {size} numbers: Outputs.rest must give the "
                "others"
            )
        if self.to != tuple(range(size)):
            self._rest = np.zeros((1, size)) if self.rest is None else np.array([self.rest])

    def allowed(self, mask: Array | None) -> Array | None:
        """Return which choices of the model a mask (n, A) allows; None: it is not for them."""
        if mask is None or mask.shape[1] != sum(self.space.counts):
            return None
        return mask if self._to is None else mask[:, self._to]

    def __call__(
        self, output: Any, n: int, mask: Array | None, turn: Turn
    ) -> tuple[Array, Array | None]:
        """Return actions (n, …) for outputs (n, …), and the outputs that a policy remembers.

        Args:
            mask: (n, A) bool, allowed actions; None: all.
            turn: it samples among logits, or takes the largest.

        Raises:
            PolicyError: they are none.
        """
        space = self.space
        if self.to is None:
            return self._decoded(output, n, space, mask, turn), output
        if space.kind == "Box":
            return self._scaled(np.asarray(output), n)
        choice = self._decoded(output, n, self._chosen, self.allowed(mask), turn)
        return (self._to[choice] + space.bounds[0]).astype(space.dtype), None

    def read(self, action: Array) -> Array:
        """Return outputs (n, count), not clipped, that lead to real actions (n, …)."""
        numbers = action.reshape(len(action), -1).astype(np.float64)
        numbers = numbers if self._to is None else numbers[:, self._to]
        if self.offset is not None:
            numbers = numbers - self.offset
        if self.scale is not None:
            scale = np.broadcast_to(self.scale, numbers.shape)
            numbers = np.divide(numbers, scale, out=0.0 * numbers, where=scale != 0.0)
        return numbers.astype(np.float32)

    def _decoded(self, output: Any, n: int, space: Space, mask: Array | None, turn: Turn) -> Array:
        """Return actions for what is actions, or for logits."""
        if not self.logits:
            return space.actions(output, n, self.who)
        output = np.asarray(output)
        if output.dtype.kind in "iub" or space.kind == "Box":
            if output.shape == (n, prod(space.shape)):  # the last layer of a network is flat
                output = output.reshape(n, *space.shape)
            return space.actions(output, n, self.who)
        bits = space.kind == "MultiBinary"
        width = prod(space.shape) if bits else sum(space.counts)
        if output.shape != (n, width):
            raise PolicyError(
                f"{self.who} returned shape {output.shape}, but {(n, width)} was expected: logits "
                f"for the actions of {space}"
            )
        if np.isnan(output).any():
            raise PolicyError(f"{self.who} returned NaN as a logit")
        rng = turn.world.rng or np.random.default_rng()
        if bits:
            noise = 0.0 if turn.greedy else rng.logistic(size=output.shape)
            found: Array = (output + noise > 0).reshape(n, *space.shape).astype(space.dtype)
            return found
        if mask is not None and mask.shape == output.shape:
            output = np.where(mask, output, -np.inf)
        if not turn.greedy:
            output = output + rng.gumbel(size=output.shape)  # argmax of it is a softmax sample
        ends = np.cumsum(space.counts)[:-1]
        best = np.stack([part.argmax(-1) for part in np.split(output, ends, axis=1)], axis=1)
        return (best.reshape(n, *space.shape) + space.bounds[0]).astype(space.dtype)

    def _scaled(self, output: Array, n: int) -> tuple[Array, Array]:
        """Return actions (n, *shape) within the space's bounds, and the clipped outputs."""
        if output.size != n * self.count or output.dtype.kind not in "iuf":
            raise PolicyError(
                f"{self.who} returned {output.dtype} of shape {output.shape}, but numbers of shape "
                f"{(n, self.count)} were expected: acts writes {self.count} numbers of an action"
            )
        if not np.isfinite(output).all():
            raise PolicyError(f"{self.who} returned a NaN or an infinity as an action")
        numbers = output.reshape(n, self.count)
        if self.clip is not None:
            numbers = clipped(numbers, *self.clip)
        space = self.space
        full = numbers
        if self.scale is not None:
            full = full * self.scale
        if self.offset is not None:
            full = full + self.offset
        if self._rest is not None:
            written = full
            full = self._rest.repeat(n, axis=0)
            full[:, self._to] = written
        full = full.reshape(n, *space.shape)
        kind = space.record
        if kind.kind in "iu":
            full = np.rint(full)
        return clipped(full, *self._bounds).astype(kind, copy=False), numbers


# Models -----------------------------------------------------------------------------------------


class Model:
    """A model from elsewhere as it acts: it makes outputs of inputs."""

    @property
    def expected(self) -> Shapes:
        """The shapes of its inputs for one environment, by name; {}: unknown."""
        return {}

    @property
    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """The shapes of its recurrent state of one environment, and their types."""
        return ()

    @property
    def first_states(self) -> Sequence[Array | None]:
        """The values that its recurrent state starts with, of one environment; None: zeros."""
        return [None] * len(self.states)

    def call(
        self, inputs: dict[str, Array], state: tuple[Array, ...], turn: Turn
    ) -> tuple[Any, Sequence[Array]]:
        """Return the outputs (n, …), and the next state.

        Args:
            inputs: by name; "": the only one.
            state: each array with the environments first.
        """
        raise NotImplementedError

    def trial(self) -> Model:
        """Return a copy to try what may be from others: it takes bounded time and memory."""
        return self


@dataclass(eq=False)
class Function(Model):
    """A user's function of inputs as it acts, perhaps with a state.

    Raises:
        PolicyError: its fields contradict each other.
    """

    function: Callable[..., Any] = code("its inputs to outputs (n, ...)", "policy")
    state: tuple[tuple[int | None, ...], ...] = ()
    """The shapes of its recurrent state, None as the axis of the environments."""
    single_state: bool = False
    """It takes and returns one array as its state, not a tuple."""
    takes_goal: Literal["", "goal", "second"] = ""
    """The argument that takes the goal of a call: named goal, or the second; "": none."""
    who: str = field(default="the policy", metadata=HERE)
    """Begins messages."""

    def __post_init__(self) -> None:
        if any(shape.count(None) != 1 for shape in self.state):
            raise PolicyError(
                f"Function.state is {self.state}, but each shape has None once: the axis of the "
                "environments"
            )
        if self.single_state and len(self.state) != 1:
            raise PolicyError(f"Function.single_state is true for {len(self.state)} arrays")
        if self.takes_goal and self.state:
            raise PolicyError("Function.takes_goal is set, but Function.state is given, too")

    @property
    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """The declared shapes, in float64."""
        return states_of(self.state)

    def call(
        self, inputs: dict[str, Array], state: tuple[Array, ...], turn: Turn
    ) -> tuple[Any, Sequence[Array]]:
        """Call the function."""
        given = {name: read_only(x) for name, x in inputs.items()}
        if self.takes_goal:
            assert turn.goal is not None
            obs = given[""]
            goal = read_only(turn.goal)
            if self.takes_goal == "second":
                return self.function(obs, goal), ()
            return self.function(obs, goal=goal), ()
        if not self.state:
            return invoke(self.function, given, (), False), ()
        before = [read_only(x) for x in of_model(state, self.state)]
        value = invoke(self.function, given, before, self.single_state)
        output, after = parted(value, self, self.who)
        return output, rows_first([np.asarray(x) for x in after], self.state, self.who)


def invoke(function: Any, inputs: dict[str, Any], state: Sequence[Any], single: bool) -> Any:
    """Call an acting policy's function or module with its inputs and its state.

    Args:
        single: the state is one array; else a tuple.
    """
    states = [state[0] if single else tuple(state)] if state else []
    if "" in inputs:
        return function(inputs[""], *states)
    return function(**inputs, **({"state": states[0]} if states else {}))


def parted(value: Any, declared: Any, who: str) -> tuple[Any, Sequence[Any]]:
    """Return output and next state of what an acting policy's function or module returned.

    Args:
        declared: has the fields ``state`` and ``single_state``.

    Raises:
        PolicyError: with a state, it is not a pair.
    """
    if not declared.state:
        return value, ()
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise PolicyError(
            f"{who} returned a {type(value).__name__}; with a state it must return two values: the "
            "output, and the next state"
        )
    output, after = value
    if declared.single_state:
        return output, (after,)
    if not isinstance(after, tuple | list):
        raise PolicyError(f"{who} returned a {type(after).__name__} as its state, not a tuple")
    return output, after


def of_model(state: Sequence[Array], shapes: Sequence[tuple[int | None, ...]]) -> list[Array]:
    """Return a state, environments first, with the environments where ``shapes`` have None."""
    return [np.moveaxis(x, 0, s.index(None)) for x, s in zip(state, shapes, strict=True)]


def rows_first(
    state: Sequence[Array], shapes: Sequence[tuple[int | None, ...]], who: str
) -> tuple[Array, ...]:
    """Return an acting model's state with the environments first; undo ``of_model``."""
    if len(state) != len(shapes):
        raise PolicyError(f"{who} returned {len(state)} arrays of state, but takes {len(shapes)}")
    for x, s in zip(state, shapes, strict=True):
        if x.ndim != len(s):
            raise PolicyError(f"{who} returned a state of shape {x.shape}, but takes {s}")
    return tuple(np.moveaxis(x, s.index(None), 0) for x, s in zip(state, shapes, strict=True))


def states_of(shapes: Sequence[tuple[int | None, ...]]) -> list[tuple[tuple[int, ...], Any]]:
    """Return declared shapes of a state as those of one environment, in float64."""
    return [(tuple(n for n in shape if n is not None), np.float64) for shape in shapes]


@dataclass(eq=False)
class OnnxFile(Model):
    """A model in ONNX's format as it acts, run by onnxruntime on the CPU.

    Raises:
        PolicyError: onnxruntime cannot run it, it has weights in other files, or its inputs and
            outputs are others than its fields name.
    """

    content: bytes = field(repr=False)
    output: str
    """The name of the output that is used."""
    inputs: tuple[str, ...]
    """The names of its inputs, without those of its state."""
    state: tuple[tuple[str, str], ...] = ()
    """Names of the recurrent state: of each input, and of the output that is its next value."""
    first: tuple[tuple[str, Array], ...] = ()
    """Names of inputs of the state that do not start with zeros, and their first values."""
    who: str = field(default="the policy", metadata=HERE)
    """Begins messages."""
    session: Any = field(default=None, repr=False, metadata={"written": False})
    """The session of onnxruntime; None: it is opened when it is needed."""

    def __post_init__(self) -> None:
        if not self.inputs:
            raise PolicyError(f"{self.who}: OnnxFile.inputs is empty")
        has = self.opened.get_inputs(), self.opened.get_outputs()
        for kind, name, ones, wanted in (
            ("input", "inputs", has[0], self.inputs),
            ("input", "state", has[0], [name for name, _ in self.state]),
            ("output", "output", has[1], [self.output]),
            ("output", "state", has[1], [after for _, after in self.state]),
        ):
            known = [one.name for one in ones]
            if missing := [x for x in wanted if x not in known]:
                raise PolicyError(
                    f"{self.who} has no {kind} {missing[0]!r} ({name}); it has: "
                    f"{', '.join(known)[:300]}"
                )
        for given in self._given.values():
            count = given.shape[0] if given.shape else "no"
            if given.name in self.inputs and isinstance(count, int) and count != 1:
                raise PolicyError(
                    f"{self.who} takes exactly {count} observations at once; export it with a "
                    "dynamic batch"
                )
            if count == "no" or given.type not in NUMBERS:
                raise PolicyError(
                    f"{self.who} takes {given.name} {given.type}{given.shape}; it must take one "
                    "batch of observations"
                )
        self._check_first()

    def _check_first(self) -> None:
        """Raise a PolicyError where a first value does not fit the state that starts with it."""
        states = dict(zip([name for name, _ in self.state], self.states, strict=True))
        shapes = {name: shape for name, (shape, _) in states.items()}
        kinds = {name: np.dtype(kind) for name, (_, kind) in states.items()}
        for name, value in self.first:
            if name not in shapes:
                raise PolicyError(f"{self.who}: OnnxFile.first has {name!r}, which is no state")
            if np.ndim(value) and np.size(value) != prod(shapes[name]):
                raise PolicyError(
                    f"{self.who}: the first value of {name!r} has {np.size(value)} numbers, but "
                    f"the state has the shape {shapes[name]}"
                )
            kind = kinds[name]
            if kind.kind in "iu":
                info = np.iinfo(kind)
                fits = (value == np.rint(value)) & (value >= info.min) & (value <= info.max)
                if not np.all(fits):
                    raise PolicyError(
                        f"{self.who}: the first value of {name!r} is {value}, but the state is of "
                        f"{kind}"
                    )

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if k not in ("opened", "_given", "_types")} | {
            "session": None
        }

    @cached_property
    def opened(self) -> Any:
        """The session of the file."""
        return open_session(self.content, self.who) if self.session is None else self.session

    @cached_property
    def _given(self) -> dict[str, Any]:
        """Its inputs, those of its state too, as the file has them."""
        named = {*self.inputs, *(name for name, _ in self.state)}
        return {i.name: i for i in self.opened.get_inputs() if i.name in named}

    @cached_property
    def _types(self) -> dict[str, type[np.generic]]:
        """The types of its inputs, without those of its state."""
        return {name: NUMBERS[self._given[name].type] for name in self.inputs}

    @cached_property
    def _axes(self) -> tuple[int, ...] | None:
        """The axis of the environments in each state; None: the model takes one at a time."""
        shapes = [self._given[name].shape for name, _ in self.state]
        free = [[i for i, n in enumerate(sizes) if not isinstance(n, int)] for sizes in shapes]
        batches = [self._given[name].shape[0] for name in self.inputs]
        if 1 in batches or any(len(axes) != 1 for axes in free):
            return None
        return tuple(axis for axes in free for axis in axes)

    @property
    def expected(self) -> Shapes:
        """The shapes of its inputs, without those of its state."""
        return {
            name: tuple(n if isinstance(n, int) else None for n in self._given[name].shape[1:])
            for name in self.inputs
        }

    @property
    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """The shapes of its recurrent state for one environment, and their types."""
        found = []
        for i, (name, _) in enumerate(self.state):
            # A symbolic size can only be that of the batch.
            sizes = [n if isinstance(n, int) else 1 for n in self._given[name].shape]
            if self._axes is not None:
                del sizes[self._axes[i]]
            found.append((tuple(sizes), NUMBERS[self._given[name].type]))
        return found

    @property
    def first_states(self) -> Sequence[Array | None]:
        """The values that its recurrent state starts with, of one environment; None: zeros."""
        known = dict(self.first)
        given = [known.get(name) for name, _ in self.state]
        return [
            x if x is None or not np.ndim(x) else np.reshape(x, shape)
            for x, (shape, _) in zip(given, self.states, strict=True)
        ]

    def call(
        self, inputs: dict[str, Array], state: tuple[Array, ...], turn: Turn
    ) -> tuple[Any, Sequence[Array]]:
        """Run the model."""
        only = {self.inputs[0]: inputs[""]} if "" in inputs else inputs
        rows = {name: np.ascontiguousarray(only[name], kind) for name, kind in self._types.items()}
        n = len(rows[self.inputs[0]])
        axes = self._axes
        if axes is not None:
            output, after = self._run(
                rows, [np.moveaxis(x, 0, k) for x, k in zip(state, axes, strict=True)]
            )
            return output, [np.moveaxis(x, k, 0) for x, k in zip(after, axes, strict=True)]
        if n == 1:
            output, after = self._run(rows, [x[0] for x in state])
            return output, [x[None] for x in after]
        each = [
            self._run({k: v[i : i + 1] for k, v in rows.items()}, [x[i] for x in state])
            for i in range(n)
        ]
        output = np.concatenate([one for one, _ in each])
        return output, [np.stack(x) for x in zip(*(after for _, after in each), strict=True)]

    def trial(self) -> OnnxFile:
        """Return a copy with another session."""
        return replace(self, session=open_session(self.content, self.who, trial=True))

    def _run(self, rows: dict[str, Array], state: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Run the model on arrays of its own shapes."""
        outputs = [self.output]
        for (name, after), value in zip(self.state, state, strict=True):
            rows = rows | {name: np.ascontiguousarray(value)}
            outputs.append(after)
        try:
            output, *states = self.opened.run(outputs, rows)
        except Exception as error:  # onnxruntime's own errors have no common class
            given = ", ".join(f"{name} {x.shape}" for name, x in rows.items())
            raise PolicyError(f"{self.who} fails on {given}: {str(error)[:500]}") from error
        return np.asarray(output), states


# The policy -------------------------------------------------------------------------------------


@dataclass(eq=False)
class Mapped(RowPolicy):
    """A model behind a mapping, as a policy that acts.

    Its memory has, where the mapping needs them: ``state.0`` and following, the recurrent state;
    ``last``, the last output; ``phase``, the steps since the last inference; ``held``, its actions;
    ``elapsed.steps`` since it took over, and ``elapsed.start``, the observation then;
    ``past.0`` and following, the last numbers of an input, and ``past.known``, that there are some.

    Raises:
        PolicyError: its fields contradict each other.
    """

    model: Model
    outputs: Outputs
    inputs: dict[str, Input] | None = None
    """By name; "": the only one. None: the whole observation."""
    every: int = 1
    """Each action is held for this number of steps."""
    chunk: int | None = None
    """The number of actions that are used of each inference; None: an inference is one action."""
    goal: Array | Callable[..., Any] | None = code(
        "observations (n, ...) to goals (n, numbers)", needed=False
    )
    """(G,) or a function: the goal, where the call that it acts in has none."""
    goal_space: Space | None = None
    """The space of the goals of calls; None: such a goal is numbers (n, G)."""
    ramp: int = 0
    """The steps, after another skill's, in which actions come from the last one; 0: none."""
    anew: tuple[str, ...] = ()
    """What begins anew where it is called again at once: of ``ANEW``."""
    entry: int = 0
    """The step at which its time starts, where it takes over."""
    sees: Space | None = None
    """The space of observations, where functions take the one at which it took over."""
    who: str = field(default="the policy", metadata=HERE)
    """Begins messages."""
    warn: Callable[[str], None] | None = field(default=None, repr=False, metadata=HERE)
    """Gives users a notice; None: they get none."""
    on_sample: str = field(default="", repr=False, metadata=HERE)
    """The notice that is given when it samples."""

    def __post_init__(self) -> None:
        for name in ("every", "chunk"):
            count = getattr(self, name)
            if count is not None and not 1 <= count <= LONGEST:
                raise PolicyError(f"Mapped.{name} is {count}; it must be 1 to {LONGEST:,}")
        if not 0 <= self.ramp <= LONGEST:
            raise PolicyError(f"Mapped.ramp is {self.ramp}; it must be 0 to {LONGEST:,}")
        if self.ramp and self.outputs.space.kind != "Box":
            raise PolicyError(f"{self.who}: ramp needs actions of a Box, not {self.outputs.space}")
        if unknown := [name for name in self.anew if name not in ANEW]:
            raise PolicyError(f"Mapped.anew has {unknown[0]!r}; there are: {', '.join(ANEW)}")
        self.holds = self.ramp > 0
        self.forgets = bool(self.anew)
        self.period = self.every * (self.chunk or 1)
        """The number of steps from one inference to the next."""
        space = self.outputs.space
        if self.chunk is not None and space.parts is not None:
            raise PolicyError(
                f"{self.who}: chunk needs actions of one array, but they are of {str(space)[:300]}"
            )
        self.takes = [take for one in (self.inputs or {}).values() for take in one.takes]
        """Sources that the inputs are made of."""
        goals, last = (
            {take.shape for take in self.takes if take.source == source}
            for source in ("goal", "last_action")
        )
        self._goal_shape = next(iter(goals), None)
        self._last = bool(last)
        self._check_goals(goals)
        if last - {(self.outputs.count,)}:
            raise PolicyError(
                f"Mapped.inputs takes the last action, which is {self.outputs.count} numbers of "
                f"{space}"
            )
        self._check_inputs()
        self._timed = any(take.timed for take in self.takes)
        if any(take.takes_call for take in self.takes) and self.sees is None:
            raise PolicyError("Mapped.inputs has a function that takes call, but no Mapped.sees")
        tables = [
            take.time.steps
            for take in self.takes
            if isinstance(take.time, Rows) and len(take.time.numbers) > 1
        ]
        self._over = min(tables, default=None)
        """The step at which the first table is over."""
        self._pasts = [
            (f"past.{i}", one.past)
            for i, one in enumerate((self.inputs or {}).values())
            if one.past is not None
        ]
        self._states = [(f"state.{i}", *one) for i, one in enumerate(self.model.states)]
        self._simple = self.inputs is None and not self._states and self.period == 1
        """It has no memory, and takes observations as they are."""
        self._fixed = None
        if self.goal is not None and not callable(self.goal):
            self._fixed = read_only(np.array([self.goal]))

    def _check_goals(self, shapes: set[tuple[int, ...]]) -> None:
        """Raise a PolicyError where goals have another number of numbers than are taken."""
        given = dict.fromkeys(shapes, "Mapped.inputs")
        if self.goal is not None and not callable(self.goal):
            given[np.shape(self.goal)] = "Mapped.goal"
        if self.goal_space is not None:
            given[(self.goal_space.size,)] = "Mapped.goal_space"
        if shapes and len(given) > 1:
            raise PolicyError(f"{' and '.join(given.values())} have goals of {list(given)}")
        if shapes and self.goal is None and self.goal_space is None:
            raise PolicyError("Mapped.inputs takes the goal, but there is no Mapped.goal")

    def _check_inputs(self) -> None:
        """Raise a PolicyError where the model takes other inputs."""
        expected = self.model.expected
        inputs = self.inputs
        goes = isinstance(self.model, Function) and self.model.takes_goal
        if goes and (self.goal_space is None or inputs is not None):
            raise PolicyError(
                "Function.takes_goal needs Mapped.goal_space, and the whole observation: no "
                "Mapped.inputs"
            )
        if inputs is None and len(expected) > 1:
            raise PolicyError(f"Mapped.inputs is missing: the model takes {', '.join(expected)}")
        if not expected or inputs is None:
            return
        if set(inputs) == {""} and len(expected) == 1:
            expected = {"": next(iter(expected.values()))}
        shapes: Shapes = {name: one.shape for name, one in inputs.items()}
        fits = set(expected) == set(inputs)
        if not fits or not all(fits_shape(inputs[k].shape, v) for k, v in expected.items()):
            raise PolicyError(f"Mapped.inputs has {shapes}, but the model takes {dict(expected)}")

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that it fits, and acts if it is data alone."""
        for name, one in (self.inputs or {}).items():
            one.check(sees, f"{where}.inputs[{name!r}]")
        takes = [*self.model.expected.values()] if self.inputs is None else []
        if takes and (sees.parts is not None or not fits_shape(sees.shape, takes[0])):
            raise PolicyError(
                f"{where}.model takes {dict(self.model.expected)}, but observations are of {sees}"
            )
        if not self.outputs.space.is_like(acts):
            raise PolicyError(f"{where}.outputs.space is {self.outputs.space}, not {acts}")
        if self.sees is not None and not self.sees.is_like(sees):
            raise PolicyError(f"{where}.sees is {self.sees}, but observations are of {sees}")
        own = self.goal_space
        if own is not None and (goal is None or not own.is_like(goal)):
            raise PolicyError(f"{where}.goal_space is {own}, but goals are of {goal}")
        if isinstance(self.model, Function):
            return
        tried = self.model.trial()
        aim = None if goal is None else goal.start(1)
        turn = Turn(World(np.random.default_rng(0)), None, aim)
        functions = [take.function for take in self.takes]
        if self.inputs is not None and (any(functions) or callable(self.goal)):
            # Functions of the user are not asked about observations that no environment gave.
            blank = {name: np.zeros((1, *one.shape)) for name, one in self.inputs.items()}
            state = tuple(np.zeros((1, *shape), kind) for shape, kind in self.model.states)
            tried.call(blank, state, turn)
            return

        def zeros(*given: Any) -> tuple[Any, Sequence[Array]]:
            """Return zeros for real numbers: what they are does not count, only their shape."""
            output, after = tried.call(*given)
            output = np.asarray(output)
            return np.zeros_like(output) if output.dtype.kind == "f" else output, after

        model: Any = SimpleNamespace(
            expected=self.model.expected, states=self.model.states, call=zeros
        )
        try:
            mapped = replace(self, model=model)
            mapped.act(self.start(1), np.zeros(1, np.int64), sees.start(1), turn)
        except PolicyError as error:
            raise PolicyError(f"{where}: {error}") from error

    def start(self, n: int) -> Memory:
        """Return the memory of n environments in which it has not acted yet."""
        memory: Memory = {key: np.zeros((n, *shape), dtype) for key, shape, dtype in self._states}
        for (key, _, _), value in zip(self._states, self.model.first_states, strict=True):
            if value is not None:
                memory[key][...] = value
        if self._timed:
            memory["elapsed.steps"] = np.full(n, self.entry)
        if self.sees is not None:
            memory["elapsed.start"] = np.zeros((n, *self.sees.shape), self.sees.record)
        if self._pasts:
            memory["past.known"] = np.zeros(n, bool)
            for key, past in self._pasts:
                memory[key] = np.zeros((n, past.length, len(past.kept)))
        if self._last:
            memory["last"] = np.zeros((n, self.outputs.count), np.float64)
        if self.period > 1:
            space = self.outputs.space
            memory["phase"] = np.zeros(n, np.int64)
            memory["held"] = np.zeros((n, self.chunk or 1, *space.shape), space.record)
        if self.ramp:
            space = self.outputs.space
            memory["ramp"] = np.full(n, UNKNOWN)
            memory["from"] = np.zeros((n, *space.shape), space.record)
        return memory

    def again(self, memory: Memory, rows: Array) -> None:
        """Begin anew what ``anew`` names."""
        names = {name: ANEW[name] for name in self.anew}
        fresh = self.start(len(rows))
        for key, value in fresh.items():
            if any(key == known or key.startswith(f"{known}.") for known in names.values()):
                memory[key][rows] = value

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …), of this inference or of an earlier one."""
        if self._timed:
            action = self._acted_in_time(memory, rows, obs, turn)
        else:
            action = self._acted(memory, rows, obs, turn)
        if self.ramp:
            action = self._ramped(memory, rows, action, turn.world)
        if self.warn is not None:
            if self.on_sample and not turn.greedy:
                self.warn(self.on_sample)
                self.on_sample = ""
            if turn.mask is not None and (text := self._forbidden(action, turn.mask)):
                self.warn(text)
                self.warn = None
        return action

    def _ramped(self, memory: Memory, rows: Array, action: Array, world: World) -> Array:
        """Return actions (k, …) that come, step by step, from the last one before its first."""
        left = memory["ramp"][rows]
        if not left.any():
            return action
        begin = np.flatnonzero(left == UNKNOWN)
        if len(begin):
            left[begin] = 0  # an episode's first action comes from nowhere
            if world.last_action is not None:
                at = rows[begin]
                left[begin] = self.ramp * world.has_acted(at)
                memory["from"][at] = world.last_action[at]
        share = (self.ramp - left + 1) / self.ramp
        mixing = np.flatnonzero(left > 1)
        memory["ramp"][rows] = np.maximum(left - 1, 0)
        return mixed(action, memory["from"][rows[mixing]], share[mixing], mixing)

    def _forbidden(self, action: Array, mask: Array) -> str:
        """Return a notice about actions (k, …) that a mask (k, A) forbids; empty: there is none."""
        space = self.outputs.space
        if not space.counts or mask.shape[1] != sum(space.counts):
            return ""
        first = np.cumsum((0, *space.counts[:-1]))
        chosen = np.take_along_axis(mask, first + space.choices_in(action), axis=1)
        free = np.logical_or.reduceat(mask, first, axis=1)  # else no option is allowed
        forbidden = np.flatnonzero((~chosen & free).any(axis=1))
        if not len(forbidden):
            return ""
        row = forbidden[0]
        return (
            f"{self.who} chose the action {action[row].tolist()}, which the environment's action "
            f"mask forbids, in {len(forbidden)} of {len(action)} environments of one step: a "
            "policy that chooses by itself must know what is allowed. Let it see the mask in the "
            "observation, return logits, which are masked, or start only where its action is "
            "allowed (initiation)"
        )

    def _acted_in_time(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …) of the model, and count the step."""
        elapsed = memory["elapsed.steps"][rows]
        if self.sees is not None:
            first = np.flatnonzero(elapsed == self.entry)
            memory["elapsed.start"][rows[first]] = obs[first]
        action = self._acted(memory, rows, obs, turn)
        memory["elapsed.steps"][rows] = elapsed + 1
        if self._over is not None and self.warn is not None and (elapsed > self._over).any():
            self.warn(
                f"{self.who}: its table was over at step {int(self._over) - self.entry} of a call "
                "that goes on: its last row stays. Let the call end there (call_steps), or give "
                "more rows"
            )
            self._over = None
        return action

    def _acted(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …) of the model."""
        if self._simple:
            output, _ = self.model.call({"": obs}, (), turn)
            return self.outputs(output, len(rows), turn.mask, turn)[0]
        if self.period == 1:
            return self._inferred(memory, rows, obs, turn)[0]
        phase = memory["phase"][rows]
        held = memory["held"]
        due = np.flatnonzero(phase == 0)
        if len(due):
            now = rows
            seen = obs
            how = turn
            if len(due) < len(rows):
                now = rows[due]
                seen = obs[due]
                how = turn.some(due)
            for i, action in enumerate(self._inferred(memory, now, seen, how)):
                held[now, i] = action
        memory["phase"][rows] = (phase + 1) % self.period
        found: Array = held[rows, phase // self.every]
        return found

    def infer(
        self, memory: Memory, rows: Array, obs: Array, turn: Turn
    ) -> tuple[Any, Sequence[Array]]:
        """Return the outputs (k, …) of the model, and its next state."""
        inputs = {"": obs}
        if self.inputs is not None:
            goal = None if self._goal_shape is None else self._aim(obs, turn)
            last = memory["last"][rows] if self._last else None
            call = self._call(memory, rows) if self._timed else None
            inputs = {name: one.now(obs, goal, last, call) for name, one in self.inputs.items()}
            if self._pasts:
                self._with_past(memory, rows, inputs)
            for name, one in self.inputs.items():
                if one.reshaped or one.last_scaling is not None:
                    inputs[name] = one.shaped(inputs[name])
        before = tuple(memory[key][rows] for key, _, _ in self._states)
        return self.model.call(inputs, before, turn)

    def _call(self, memory: Memory, rows: Array) -> InCall:
        """Return the time since it took over."""
        start = memory["elapsed.start"][rows] if self.sees is not None else np.zeros(len(rows))
        return InCall(read_only(memory["elapsed.steps"][rows]), read_only(start), self.entry)

    def _with_past(self, memory: Memory, rows: Array, numbers: dict[str, Array]) -> None:
        """Replace the numbers of inputs that have a past by those with it, and remember them."""
        assert self.inputs is not None
        known = memory["past.known"][rows]
        memory["past.known"][rows] = True
        for i, (name, one) in enumerate(self.inputs.items()):
            if one.past is not None:
                kept = memory[f"past.{i}"][rows]
                numbers[name] = one.past(kept, known, numbers[name])
                memory[f"past.{i}"][rows] = kept

    def _inferred(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> list[Array]:
        """Return the next actions, (k, …) each."""
        n = len(rows)
        outputs = self.outputs
        chunk = self.chunk
        output, after = self.infer(memory, rows, obs, turn)
        if chunk is None:
            several = [output]
        else:
            output = np.asarray(output)
            more = outputs.count > 1 and (outputs.logits or outputs.space.kind == "Box")
            if output.ndim < 2 + more or output.shape[1] < chunk:
                raise PolicyError(
                    f"{self.who} returned shape {output.shape}, but chunk={chunk} needs "
                    f"(n, {chunk}, ...): {chunk} actions for each environment"
                )
            several = [output[:, i] for i in range(chunk)]
        actions = []
        for i, one in enumerate(several):
            action, numbers = outputs(one, n, turn.mask if i == 0 else None, turn)
            actions.append(action)
        for (key, shape, _), value in zip(self._states, after, strict=True):
            if value.shape != (n, *shape):
                raise PolicyError(
                    f"{self.who} returned a state of shape {value.shape}, but it was given "
                    f"{(n, *shape)}"
                )
            memory[key][rows] = value
        if self._last:
            memory["last"][rows] = np.asarray(numbers).reshape(n, -1)
        return actions

    def _aim(self, obs: Array, turn: Turn) -> Array:
        """Return the goals (n, G): of the calls, the fixed one, or those of the user's function."""
        goal = turn.goal
        if goal is not None:
            if self.goal_space is not None:
                return self.goal_space.flat(goal)
            if goal.shape != (len(obs), *(self._goal_shape or ())):
                raise PolicyError(
                    f"{self.who}: the goal has shape {goal.shape}, but {self._goal_shape} was "
                    f"expected for each of {len(obs)} environments"
                )
            return goal
        if self._fixed is not None:
            return self._fixed if len(obs) == 1 else self._fixed.repeat(len(obs), axis=0)
        assert callable(self.goal)
        return numbers_of(self.goal, obs, f"{self.who}: goal()", self._goal_shape)


def fits_shape(shape: tuple[int, ...], wanted: tuple[int | None, ...] | None) -> bool:
    """Return whether a shape of a model's file is the wanted one; None: any number, or shape."""
    return wanted is None or (
        len(shape) == len(wanted)
        and all(b is None or a == b for a, b in zip(shape, wanted, strict=True))
    )
