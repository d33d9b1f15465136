"""ONNX files as policies."""

from __future__ import annotations

import copy
import math
import re
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self, overload

import numpy as np
from gymnasium import Space

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short, shortened
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, PolicyError, RunError, needs_extra
from skillweave.policies.core import Array, RowPolicy
from skillweave.policies.mapped import OnnxFile, fits_shape
from skillweave.policies.sessions import open_session
from skillweave.policies.spaces import space_of
from skillweave.policies.untrusted import check_file
from skillweave.schema import fitted
from skillweave.skills.foreign_policy import SEES
from skillweave.skills.learnable import PLAIN_PPO, Learnable, NetworkFile, check_learns_on
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.mapping import PolicyMapping, Scaling, mapping_of
from skillweave.skills.onnx_layers import read_network

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
        inputs = self._session.get_inputs()
        states = {name for name, *_ in self.mapping.state}
        free = [i for i in inputs if i.name not in states]
        several = self.mapping.sees is not None and "" not in self.mapping.sees
        if not free or (len(free) > 1 and not several):
            found = shortened(", ".join(f"{i.name} {i.type}{i.shape}" for i in inputs))
            more = ""
            if free:
                more = (
                    f". Say what each input sees: sees={{{free[0].name!r}: ..., ...}}; of a "
                    f"recurrent state, its next value: state={{{free[-1].name!r}: 'an output'}}"
                )
            raise PolicyError(
                f"{file} takes {found or 'nothing'}; it must take one batch of observations{more}"
            )
        self._chooses = output is None
        self.output = output or self._session.get_outputs()[0].name
        self.free = [i.name for i in free]
        _ = self.model  # which checks the file

    @property
    def model(self) -> OnnxFile:
        """The acting model of the file."""
        declared = self.mapping.state
        state = tuple((name, after) for name, after, *_ in declared)
        first = tuple((name, np.array(value[0])) for name, _, *value in declared if value)
        how = tuple(self.free), state, first, self._who, self._session
        return OnnxFile(self.data, self.output, *how)

    @cached_property
    def _session(self) -> Any:
        with needs_extra("an ONNX file", "onnx"):
            return open_session(self.data, self.name)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if k != "_session"}

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy for these spaces.

        Raises:
            PolicyError: its input has another shape; the message names both.
        """
        bound = super().bind(observation_space, action_space, who)
        if self.mapping.sees is not None:
            return bound
        mine = self.model.expected[self.free[0]] or ()
        if not fits_shape(bound.observation_space.shape or (), mine):
            shape = f"({', '.join('n' if n is None else str(n) for n in mine)})"
            raise PolicyError(
                f"{bound._who} takes observations of shape {shape}, but the environment has "
                f"{observation_space}: {SEES}"
            )
        return bound

    @cached_property
    def in_place(self) -> RowPolicy:  # type: ignore[override]
        """The policy that acts, with the output of the actions chosen by its name.

        Where names do not decide, shapes do.
        """
        self.must_be_bound()
        if not self._chooses:
            return super().in_place
        space = space_of(self.action_space)
        size = space.size
        choices = sum(space.counts)
        after = [after for _, after, *_ in self.mapping.state]
        ranks: dict[tuple[bool, ...], list[str]] = {}
        for output in self._session.get_outputs():
            numbers = math.prod(n for n in output.shape[1:] if isinstance(n, int))
            rank = (
                output.name in after,
                *_rank(output.name, choices > 0),
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
        return super().in_place

    def normalized(self) -> dict[str, tuple[Array, Array]]:
        """Return means and deviations that the graph subtracts from inputs, and divides by."""
        with needs_extra("an ONNX file", "onnx"):
            import onnx
            import onnx.numpy_helper
        graph = onnx.load_from_string(self.data).graph
        known = {one.name: onnx.numpy_helper.to_array(one) for one in graph.initializer}
        for node in graph.node:
            if node.op_type == "Constant" and node.attribute[0].name == "value":
                known[node.output[0]] = onnx.numpy_helper.to_array(node.attribute[0].t)
        names = {name: name for name in self.free} if len(self.free) > 1 else {self.free[0]: ""}
        found: dict[str, tuple[Array, Array]] = {}
        centred: dict[str, tuple[str, Array]] = {}
        for node in graph.node:
            first, *more = node.input
            second = known.get(more[0]) if more else None
            if second is None or second.dtype.kind != "f":
                continue
            if node.op_type == "Sub" and first in names:
                centred[node.output[0]] = names[first], second
            elif node.op_type in ("Div", "Mul") and first in centred:
                name, mean = centred[first]
                with np.errstate(divide="ignore"):
                    deviation = second if node.op_type == "Div" else 1.0 / second
                found[name] = np.float64(mean).reshape(-1), np.float64(deviation).reshape(-1)
        return super().normalized() | found

    def source(self) -> dict[str, Any]:
        """Return the file, the checksum of the copy that the run keeps, and the mapping."""
        return super().source() | {"file": self.name}

    def content(self) -> bytes:
        """Return the whole model."""
        return self.data

    def restored(self, content: bytes) -> Self:
        """Return a policy with the same spaces and mapping, and this model."""
        policy = copy.copy(self)
        policy.data = content
        vars(policy).pop("_session", None)
        given, mine = ({i.name: i.shape for i in x._session.get_inputs()} for x in (policy, self))
        if given != mine:
            raise RunError(f"{self._who}: the copy in the run has other inputs: {short(given)}")
        return policy


def _rank(output: str, choices: bool) -> tuple[bool, ...]:
    """Return how little an output is named like an action, or like logits of ``choices``."""
    name = output.lower()
    return (
        OTHER.search(name) is not None,
        ACTION.search(name) is None,
        choices and "logit" not in name,
        "deterministic" not in name,
        name not in ("action", "actions"),
    )


def _is_pair(pair: Any) -> bool:
    """Return whether a part of a declared state names an input and an output."""
    return len(pair) > 1 and all(isinstance(name, str) for name in pair[:2])


@overload
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
    anew: Any = (),
    entry: int = 0,
    observation_space: Any = None,
    action_space: Any = None,
    learn: Literal[False] = False,
) -> OnnxPolicy: ...


@overload
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
    anew: Any = (),
    entry: int = 0,
    observation_space: Any = None,
    action_space: Any = None,
    learn: Literal[True],
) -> Learnable: ...


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
    anew: Any = (),
    entry: int = 0,
    observation_space: Any = None,
    action_space: Any = None,
    learn: bool = False,
) -> OnnxPolicy | Learnable:
    """Return an ONNX file as a skill's policy; the run keeps a copy of it.

    It takes a batch of observations, of any size or of one. Whole numbers that it returns are
    actions; other numbers are logits for Discrete and MultiDiscrete, actions for Box.

    ``sees`` lists the numbers of the policy's input in their order: keys of a Dict observation,
    places and slices of its flat form, ``Part(...)`` with scale and offset, ``Goal()``,
    ``LastAction()``, the clock ``Elapsed()``, a ``Table(...)``, and functions of observations that
    return (n, numbers). ``Part``, ``Goal`` and ``LastAction`` may have a ``history``. A function
    with a parameter ``call`` also gets the time since the skill took over: ``call.steps`` (n,),
    and ``call.start``, the observations of that step. Of several inputs it has a list each, by
    name: ``{"obs": ("gyro", "joints"), "command": Goal()}``.

    With ``learn=True`` the skill is trained by ``PPO``, and begins with the network in the file:
    linear layers with one kind of nonlinearity between them, perhaps with a normalisation of the
    input, and a last Tanh. Its actions begin as those of the file, through ``sees`` and ``acts``;
    the critic and the deviation of actions (``PPO(action_std_init=...)``, in the unit of the file's
    outputs) start afresh. ``acts`` is applied to sampled outputs. A fixed ``goal`` stays, and the
    weights of its inputs with it. ``Run.save_onnx`` writes the result as the same file with other
    weights. Such a policy has no time or memory of its own: in ``sees`` neither ``LastAction()``
    nor ``Elapsed()``, ``Table(...)``, ``history`` or ``call``; ``every``, ``chunk``, ``state``,
    ``anew``, ``entry``, and ``ramp``, ``to`` and ``rest`` of ``Acts`` are refused, too.

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
            each input: ``{"h_in": "h_out"}``. It starts with zeros, or with a value that is given
            beside the name: ``{"time_step": ("next_step", 1.0)}``.
        anew: what begins anew where the skill is called again at once: "state", "last_action",
            "held" (of ``every`` and ``chunk``), "elapsed" (clocks, tables and ``call``; with
            ``every`` name "held", too), "history", or several. The rest goes on; after another
            skill's call all begins anew.
        entry: the step at which time starts where the skill takes over, of ``Elapsed``, ``Table``
            and ``call`` in ``sees``: a motion is entered in its middle.
        observation_space: None: the environment's.
        action_space: None: the environment's.
        learn: the skill learns on from the file.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``; with ``learn=True`` for a skill's
        ``policy``.

    Raises:
        RunError: the file does not exist.
        PolicyError: it is not a model of one batch of observations, or cannot learn on.
        DeclarationError: an argument is wrong; the message names it.
        MissingExtra: the extra 'onnx' is not installed.
    """
    mapping = mapping_of(
        "from_onnx()", sees, goal, acts, every, chunk, state, anew=anew, entry=entry
    )
    if any(not _is_pair(pair) for pair in mapping.state):
        raise DeclarationError(
            "from_onnx(): state gives shapes; name the inputs and outputs of the file: "
            "state={'h_in': 'h_out'}"
        )
    fitted(bool, learn, "from_onnx(): learn")
    if learn:
        check_learns_on(mapping, f"from_onnx(learn=True): {path}")
    with needs_extra("an ONNX file", "onnx"):
        import onnx
        import onnx.numpy_helper
    check_file(Path(path))
    try:
        model = onnx.load(str(path))
    except OSError as error:
        raise RunError(f"could not read {path}: {error.strerror or error}") from error
    except Exception as error:  # protobuf's own errors have no common class
        raise PolicyError(f"{path} is no ONNX model: {str(error)[:300]}") from error
    for tensor in model.graph.initializer:
        where = f"{path}: its weights {tensor.name[:60]!r}"
        try:
            array = onnx.numpy_helper.to_array(tensor)
        except Exception as error:
            raise PolicyError(f"{where} are damaged: {str(error)[:300]}") from error
        if array.dtype.kind == "f" and np.isnan(array).any():
            raise PolicyError(f"{where} hold NaN")
    data = model.SerializeToString(deterministic=True)
    if learn:
        names = [x.name for x in model.graph.output]
        chosen = _chosen(names, str(path)) if output is None else output
        return _learnable(data, str(path), chosen, mapping, observation_space, action_space)
    return OnnxPolicy(data, Path(path), output, observation_space, action_space, mapping)


def _chosen(names: list[str], path: str) -> str:
    """Return the output that is named like an action.

    Raises:
        DeclarationError: no name is, or several are.
    """
    ranks = [_rank(name, choices=False) for name in names]
    best = [name for name, rank in zip(names, ranks, strict=True) if rank == min(ranks)]
    if len(best) == 1:
        return best[0]
    raise DeclarationError(
        f"from_onnx(learn=True): {path} has the outputs {', '.join(names) or 'none'}; name the one "
        f"that is the action, output={names[0] if names else ''!r}"
    )


def _learnable(
    data: bytes,
    path: str,
    output: str,
    mapping: PolicyMapping,
    observation_space: Any,
    action_space: Any,
) -> Learnable:
    """Return the network in a file, for a skill that learns on.

    Raises:
        PolicyError: the network is of another kind.
    """
    found = read_network(data, output, path)
    if found.normalizes:
        own = Scaling(offset=found.offset, scale=found.scale)
        mapping = replace(mapping, scaling={"": own})
    file = NetworkFile(path, output, found.input, found.shape, found.squashes, mapping, data)
    return Learnable(
        path,
        "PPO",
        {"actor": found.layers},
        observation_space=observation_space,
        action_space=action_space,
        settings=PLAIN_PPO | {"squash_actions": found.squashes},
        file=file,
    )
