"""ONNX files as policies."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium import Space

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, MissingExtra, PolicyError, RunError
from skillweave.messages import short, shortened
from skillweave.notices import notice
from skillweave.reading import check_file
from skillweave.skills.foreign_policy import SEES, checksum
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.mapping import PolicyMapping, mapping_of
from skillweave.skills.plan import Shapes
from skillweave.types import Array

NUMBERS = {
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
OTHER = re.compile(
    "(?<!q)(?<!q_)value|vf|critic|baseline|adv|std|sigma|var|entropy|log_?p|shape|size|version|"
    "state|hidden|(?<![a-z])[hc]_"
)
"""Names of outputs that are no actions."""
ACTION = re.compile("action|logit|mean|policy|(?<![a-z])(act|mu|loc|pi|q)(?![a-z])|q_?value")
"""Names of outputs that are actions, or by which one is chosen."""


class OnnxPolicy(MappedPolicy):
    """A model in ONNX's format, run by onnxruntime on the CPU."""

    kind = "onnx"
    suffix = ".onnx"
    extra: tuple[str, ...] = ()
    """Inputs that are neither observations nor state; see ``more_inputs``."""

    def __init__(
        self,
        data: bytes,
        file: Path,
        output: str | None = None,
        observation_space: Any = None,
        action_space: Any = None,
        mapping: PolicyMapping | None = None,
    ) -> None:
        super().__init__(str(file), observation_space, action_space, mapping)
        self.data = data
        self.file = file
        self._session = _session(data, file)
        inputs = self._session.get_inputs()
        outputs = self._session.get_outputs()
        names = [o.name for o in outputs]
        if output is not None and output not in names:
            has = shortened(", ".join(names))
            raise PolicyError(f"{file} has no output {output!r}; it has: {has}")
        states = dict(self.mapping.state)
        for name, after in states.items():
            _check_state(name, after, [i.name for i in inputs], names, file)
        free = [i for i in inputs if i.name not in states and i.name not in self.extra]
        several = self.mapping.sees is not None and "" not in self.mapping.sees
        odd = next((i for i in free if not i.shape or i.type not in NUMBERS), None)
        if odd is not None or not free or (len(free) > 1 and not several):
            found = shortened(", ".join(f"{i.name} {i.type}{i.shape}" for i in inputs))
            more = ""
            if odd is None and free:
                more = (
                    f". Say what each input sees: sees={{{free[0].name!r}: ..., ...}}; of a "
                    f"recurrent state, its next value: state={{{free[-1].name!r}: 'an output'}}"
                )
            raise PolicyError(
                f"{file} takes {found or 'nothing'}; it must take one batch of observations{more}"
            )
        self._chooses = output is None
        self.output = output or names[0]
        self._inputs = {i.name: i for i in inputs}
        self.free = [i.name for i in free]
        batches = [self._inputs[name].shape[0] for name in self.free]
        odd_batch = next((n for n in batches if isinstance(n, int) and n != 1), None)
        if odd_batch is not None:
            raise PolicyError(
                f"{file} takes exactly {odd_batch} observations at once; export it with a dynamic "
                "batch"
            )
        axes = [_environments(self._inputs[name].shape) for name in states]
        self._axes: tuple[int, ...] | None = None
        """The axis of the environments in each state; None: the model takes one at a time."""
        if 1 not in batches and None not in axes:
            self._axes = tuple(axis for axis in axes if axis is not None)

        self._plain = len(self.free) == 1 and not states and not self.extra
        self._dtype = NUMBERS[self._inputs[self.free[0]].type]

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if k not in ("_session", "_inputs")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._session = _session(self.data, self.file)
        self._inputs = {i.name: i for i in self._session.get_inputs()}

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy for these spaces.

        Raises:
            PolicyError: its input has another shape; the message names both.
        """
        bound = super().bind(observation_space, action_space, who)
        if self.mapping.sees is not None:
            return bound
        mine = self._inputs[self.free[0]].shape[1:]
        theirs = bound.observation_space.shape or ()
        fits = len(mine) == len(theirs) and all(
            a == b for a, b in zip(mine, theirs, strict=True) if isinstance(a, int)
        )
        if not fits:
            shape = f"({', '.join(map(str, mine))})"
            raise PolicyError(
                f"{bound._who} takes observations of shape {shape}, but the environment has "
                f"{observation_space}: {SEES}"
            )
        return bound

    def fit_mapping(self) -> None:
        """Fit the mapping to the spaces, and choose the output of the actions by its name.

        Where names do not decide, shapes do.
        """
        super().fit_mapping()
        if not self._chooses:
            return
        from skillweave.spaces import choice_counts, obs_shape

        size = math.prod(obs_shape(self.action_space))
        choices = sum(choice_counts(self.action_space))
        after = dict(self.mapping.state).values()
        ranks: dict[tuple[bool, ...], list[str]] = {}
        for output in self._session.get_outputs():
            name = output.name.lower()
            numbers = math.prod(n for n in output.shape[1:] if isinstance(n, int))
            rank = (
                output.name in after,
                OTHER.search(name) is not None,
                ACTION.search(name) is None,
                choices > 0 and "logit" not in name,
                "deterministic" not in name,
                name not in ("action", "actions"),
                numbers != (choices if choices and "int" not in output.type else size),
            )
            ranks.setdefault(rank, []).append(output.name)
        best = ranks[min(ranks)]
        self.output = best[0]
        if len(best) > 1:
            notice(
                f"{self._who}: any of its outputs {', '.join(best)} could be the action, and "
                f"{self.output!r} is used: name the right one, output={self.output!r}"
            )

    def expected(self) -> Shapes:
        """Return the shapes of its inputs, without those of its state."""
        shapes = {name: self._inputs[name].shape[1:] for name in self.free}
        return {
            name: tuple(n if isinstance(n, int) else None for n in shape)
            for name, shape in shapes.items()
        }

    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """Return the shapes of its recurrent state for one environment, and their types."""
        found = []
        for i, (name, _) in enumerate(self.mapping.state):
            given = self._inputs[name]
            sizes = list(given.shape)
            if self._axes is not None:
                del sizes[self._axes[i]]
            else:  # a symbolic size can only be that of the batch
                sizes = [n if isinstance(n, int) else 1 for n in sizes]
            found.append((tuple(sizes), NUMBERS[given.type]))
        return found

    def single_states(self) -> tuple[tuple[str, str, tuple[int, ...]], ...]:
        """Return the inputs, outputs and shapes of its recurrent state, as of one environment."""
        shapes = (self._inputs[name].shape for name, _ in self.mapping.state)
        single = [tuple(n if isinstance(n, int) else 1 for n in shape) for shape in shapes]
        return tuple((*pair, shape) for pair, shape in zip(self.mapping.state, single, strict=True))

    def call(
        self,
        inputs: Any,
        state: tuple[Array, ...],
        mask: Array | None,
        deterministic: bool,
        rng: np.random.Generator | None,
    ) -> tuple[Array, tuple[Array, ...]]:
        """Run the model."""
        free = self.free
        if self._plain:
            x: Any = inputs.get("", inputs.get(free[0])) if isinstance(inputs, dict) else inputs
            if self._axes is not None or len(x) == 1:
                rows = {free[0]: np.ascontiguousarray(x, self._dtype)}
                return self._outputs([self.output], rows)[0], ()
        given = (
            inputs
            if isinstance(inputs, dict) and "" not in inputs
            else {free[0]: inputs[""] if isinstance(inputs, dict) else inputs}
        )
        rows = {
            name: np.ascontiguousarray(given[name], NUMBERS[self._inputs[name].type])
            for name in free
        }
        if self.extra:
            rows |= self.more_inputs(len(rows[free[0]]), mask, rng)
        if self._axes is None and len(rows[free[0]]) != 1:
            found = [
                self._run({k: v[i : i + 1] for k, v in rows.items()}, [x[i] for x in state])
                for i in range(len(rows[free[0]]))
            ]
            output = np.concatenate([one for one, _ in found])
            return output, tuple(np.stack(x) for x in zip(*(s for _, s in found), strict=True))
        if self._axes is None:
            output, after = self._run(rows, [x[0] for x in state])
            return output, tuple(x[None] for x in after)
        axes = self._axes
        output, after = self._run(
            rows, [np.moveaxis(x, 0, axis) for x, axis in zip(state, axes, strict=True)]
        )
        return output, tuple(np.moveaxis(x, axis, 0) for x, axis in zip(after, axes, strict=True))

    def more_inputs(
        self, n: int, mask: Array | None, rng: np.random.Generator | None
    ) -> dict[str, Array]:
        """Return the inputs named in ``extra``, for n environments."""
        return {}

    def _run(self, rows: dict[str, Array], state: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Run the model on arrays of its own shapes."""
        outputs = [self.output]
        for (name, after), value in zip(self.mapping.state, state, strict=True):
            rows = rows | {name: np.ascontiguousarray(value)}
            outputs.append(after)
        output, *states = self._outputs(outputs, rows)
        return np.asarray(output), states

    def _outputs(self, names: Sequence[str], rows: dict[str, Array]) -> Any:
        """Return the outputs of the model; a PolicyError names the policy where it fails."""
        try:
            return self._session.run(names, rows)
        except Exception as error:  # onnxruntime's own errors have no common class
            raise self._failure(error) from error

    def source(self) -> dict[str, Any]:
        """Return the file, the checksum of the copy that the run keeps, and the mapping."""
        found = {k: v for k, v in super().source().items() if k != "name"}
        return found | {"file": str(self.file), "sha256": checksum(self.data)}

    def content(self) -> bytes:
        """Return the whole model."""
        return self.data

    def restored(self, content: bytes) -> Self:
        """Return a policy with the same spaces and mapping, and this model."""
        policy = copy.copy(self)
        policy.data = content
        policy._session = _session(content, self.file)
        given = {i.name: i.shape for i in policy._session.get_inputs()}
        if given != {name: i.shape for name, i in self._inputs.items()}:
            raise RunError(f"{self._who}: the copy in the run has other inputs: {short(given)}")
        return policy


def _check_state(
    name: str, after: str, inputs: Sequence[str], outputs: Sequence[str], file: Path
) -> None:
    """Raise a PolicyError where a state names an input or an output that does not exist."""
    for what, found, known in (("input", name, inputs), ("output", after, outputs)):
        if found not in known:
            has = shortened(", ".join(known))
            raise PolicyError(f"{file}: state names {what} {found!r}; the file has: {has}")


def _environments(shape: Sequence[Any]) -> int | None:
    """Return the axis of the environments in a state's shape; None: it is of one environment."""
    axes = [i for i, n in enumerate(shape) if not isinstance(n, int)]
    return axes[0] if len(axes) == 1 else None


@checked_names
def from_onnx(
    path: str | Path,
    *,
    output: str | None = None,
    sees: Any = None,
    goal: Any = None,
    acts: Any = None,
    every: int = 1,
    chunk: int | None = None,
    state: Any = None,
    observation_space: Any = None,
    action_space: Any = None,
) -> OnnxPolicy:
    """Return an ONNX file as a skill's policy; the run keeps a copy of it.

    It takes a batch of observations, of any size or of one. Whole numbers that it returns are
    actions; other numbers are logits for Discrete and MultiDiscrete, actions for Box.

    ``sees`` lists the numbers of the policy's input in their order: keys of a Dict observation,
    places and slices of its flat form, ``Part(...)`` with scale and offset, ``Goal()``,
    ``LastAction()``, and functions of observations that return (n, numbers). Of several inputs it
    has a list each, by name: ``{"obs": ("gyro", "joints"), "command": Goal()}``.

    Args:
        path: the file; weights in a second file beside it are read, too.
        output: the name of the output to use; None: the one that is named like an action, else
            the one of the actions' shape, and never a value where there is another.
        sees: the parts of the observation that the policy takes; None: the whole observation.
        goal: the value of ``Goal()`` in ``sees``, a command for example: numbers, or a function of
            observations that returns (n, numbers).
        acts: the meaning of the output, ``Acts(...)``; None: it is the action.
        every: each action is held for this number of steps.
        chunk: the number of actions that are used of each inference, where the output is
            (n, H, ...): a sequence of H actions. None: an inference gives one action.
        state: the recurrent state: the name of the output that is the next state, by the name of
            each input: ``{"h_in": "h_out"}``. It starts with zeros.
        observation_space: None: the environment's.
        action_space: None: the environment's.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``.

    Raises:
        RunError: the file does not exist.
        PolicyError: it is not a model of one batch of observations.
        DeclarationError: an argument is wrong; the message names it.
        MissingExtra: the extra 'onnx' is not installed.
    """
    mapping = mapping_of(
        "from_onnx()", sees=sees, goal=goal, acts=acts, every=every, chunk=chunk, state=state
    )
    if mapping.state and not isinstance(state, dict):
        raise DeclarationError(
            "from_onnx(): state gives shapes; name the inputs and outputs of the file: "
            "state={'h_in': 'h_out'}"
        )
    try:
        import onnx
    except ImportError as error:
        raise MissingExtra("an ONNX file", "onnx") from error
    check_file(Path(path))
    try:
        model = onnx.load(str(path))
    except OSError as error:
        raise RunError(f"could not read {path}: {error.strerror or error}") from error
    except Exception as error:  # protobuf's own errors have no common class
        raise PolicyError(f"{path} is no ONNX model: {str(error)[:300]}") from error
    for tensor in model.graph.initializer:
        if np.isnan(_numbers(tensor, path)).any():
            raise PolicyError(f"{path}: its weights {tensor.name[:60]!r} hold NaN")
    return OnnxPolicy(
        model.SerializeToString(deterministic=True),
        Path(path),
        output,
        observation_space,
        action_space,
        mapping,
    )


def _numbers(tensor: Any, path: str | Path) -> Array:
    """Return a weight as an array; empty if it does not hold real numbers."""
    from onnx import numpy_helper

    try:
        array = numpy_helper.to_array(tensor)
    except Exception as error:
        raise PolicyError(
            f"{path}: its weights {tensor.name[:60]!r} are damaged: {str(error)[:300]}"
        ) from error
    return array if np.issubdtype(array.dtype, np.floating) else np.zeros(0)


def _tensors(message: Any) -> Iterator[Any]:
    """Yield every tensor in an ONNX message: of all graphs, functions and attributes."""
    if hasattr(message, "data_location"):
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in (value,) if hasattr(value, "ListFields") else value:
                yield from _tensors(part)


def _session(data: bytes, file: Path) -> Any:
    """Return a session of a model; a PolicyError where it would read other files, or is damaged."""
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise MissingExtra("an ONNX file", "onnx") from error
    try:
        model = onnx.load_from_string(data)
    except Exception as error:  # protobuf's own errors have no common class
        raise PolicyError(f"{file} is no ONNX model: {str(error)[:300]}") from error
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in _tensors(model)):
        raise PolicyError(
            f"{file} has weights in other files, which no checksum covers: save it as one file"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # small nets; and exact
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own errors have no common class
        reason = shortened(str(error))
        raise PolicyError(f"{file} cannot be run by onnxruntime: {reason}") from error
