"""Graphs of foreign networks, like those of trained agents.

Stands alone because they are no agents: their inputs and outputs are their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box, MultiBinary
from torch import Tensor, nn

from skillweave.export.graphs import Graph, leaves_of, traced
from skillweave.ops.device import BOOL, FLOAT
from skillweave.skills.onnx_file import OnnxPolicy
from skillweave.skills.torch_module import TorchPolicy
from skillweave.spaces import action_codec, obs_dtype
from skillweave.spaces.packing import parts
from skillweave.types import Array


class _Module(nn.Module):
    """A user's module on one observation, as ``TorchPolicy`` runs it."""

    def __init__(self, policy: TorchPolicy, masked: bool) -> None:
        super().__init__()
        self.module, self.masked = policy.module, masked
        self.spaces = policy.observation_space, policy.action_space

    def forward(self, *given: Tensor) -> Tensor:
        """Return the action; inputs: leaves, mask, noise."""
        left = iter(given)
        output = self.module(_nested(self.spaces[0], left))
        mask = next(left) if self.masked else None
        return _decoded(output, self.spaces[1], mask, next(left, None))


def _nested(space: gym.Space[Any], leaves: Iterator[Tensor]) -> Any:
    """Return the leaves in the structure of the module's input."""
    inner = parts(space)
    if inner is None:
        return next(leaves).float()
    values = {name: _nested(part, leaves) for name, part in inner.items()}
    return tuple(values.values()) if isinstance(space, gym.spaces.Tuple) else values


def _decoded(
    output: Tensor, space: gym.Space[Any], mask: Tensor | None, noise: Tensor | None
) -> Tensor:
    """Convert a network's output (1, …) to an action, as ``skills.outputs.decoded`` does."""
    shape = (1, *(space.shape or ()))
    dtype = torch.from_numpy(np.empty(0, space.dtype)).dtype
    if isinstance(space, Box):
        low, high = (torch.from_numpy(x) for x in (space.low, space.high))
        return output.reshape(shape).to(dtype).clamp(low, high)
    if not output.is_floating_point():
        return output.reshape(shape).to(dtype)
    if noise is not None:
        output = output + noise
    if isinstance(space, MultiBinary):
        return (output > 0).reshape(shape).to(dtype)
    if mask is not None:
        output = output.masked_fill(~mask, -torch.inf)
    codec = action_codec(space)
    best = torch.stack([x.argmax(-1) for x in output.split(list(codec.parts), dim=1)], dim=1)
    return (best.reshape(shape) + torch.from_numpy(_start(space))).to(dtype)


def module_graph(policy: TorchPolicy, sampled: bool, where: str) -> Graph:
    """Return the graph of a user's module; inputs and outputs as in ``agent_graph``.

    Raises:
        PolicyError: it cannot be written as ONNX; the message begins with ``where``.
    """
    space = policy.observation_space
    choices = _choices(policy)
    noise = _noise(policy, sampled)
    given = {leaf.name: leaf.example() for leaf in leaves_of(space)}
    if choices:
        given["mask"] = torch.ones(1, choices, **BOOL)
    given |= {f"noise.{i}": torch.zeros(1, n, **FLOAT) for i, (_, n) in enumerate(noise)}
    module = _Module(policy, bool(choices)).eval()
    return Graph(traced(module, given, ["action"], where), choices, noise=noise)


def file_graph(policy: OnnxPolicy, sampled: bool) -> Graph:
    """Return the graph around an ONNX file; inputs and outputs as in ``agent_graph``.

    The file's own nodes stay as they are. Nodes before them convert an observation to the input;
    nodes after them convert the output to an action, as ``skills.outputs.decoded`` does.
    """
    import onnx
    from onnx import helper

    model = onnx.compose.add_prefix(onnx.load_from_string(policy.data), "own.")
    weights = {w.name for w in model.graph.initializer}
    source = next(i for i in model.graph.input if i.name not in weights)
    output = next(o for o in model.graph.output if o.name == f"own.{policy.output}")
    choices, noise = _choices(policy), _noise(policy, sampled)
    obs, space, dtype = policy.observation_space, policy.action_space, _onnx_type
    nodes = _Nodes(model.graph)
    seen = helper.make_node("Cast", ["obs"], [source.name], to=source.type.tensor_type.elem_type)
    real = output.type.tensor_type.elem_type in _REAL
    action = nodes.action(output.name, space, real, bool(choices), bool(noise))
    given = [("obs", dtype(obs_dtype(obs)), [1, *obs.shape])]
    given += [("mask", dtype(np.bool_), [1, choices])] * bool(choices)
    given += [(f"noise.{i}", dtype(np.float32), [1, n]) for i, (_, n) in enumerate(noise)]
    graph = helper.make_graph(
        [seen, *model.graph.node, *nodes.added],
        "policy",
        [helper.make_tensor_value_info(*x) for x in given],
        [helper.make_tensor_value_info(action, dtype(space.dtype), [1, *(space.shape or ())])],
        model.graph.initializer,
    )
    whole = helper.make_model(graph, opset_imports=model.opset_import, functions=model.functions)
    whole.ir_version = model.ir_version
    return Graph(whole.SerializeToString(deterministic=True), choices, noise=noise)


_REAL = (1, 10, 11, 16)  # ONNX's numbers of float32, float16, float64 and bfloat16


def _onnx_type(dtype: Any) -> int:
    from onnx import helper

    return int(helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))


class _Nodes:
    """Operations behind a file's own ones."""

    def __init__(self, graph: Any) -> None:
        self.graph, self.added = graph, list[Any]()

    def then(self, kind: str, *given: str | Array, out: str = "", **attributes: Any) -> str:
        """Add one operation on results of others and constants; return the name of its result."""
        from onnx import helper, numpy_helper

        out = out or f"then.{len(self.added)}"
        names: list[str] = []
        for value in given:
            if not isinstance(value, str):
                fixed = numpy_helper.from_array(value, f"{out}.{len(names)}")
                self.graph.initializer.append(fixed)
                value = fixed.name
            names.append(value)
        self.added.append(helper.make_node(kind, names, [out], **attributes))
        return out

    def action(self, x: str, space: Any, real: bool, masked: bool, noisy: bool) -> str:
        """Add the conversion of an output ``x`` to an action; return the action's name."""
        shape = np.array([1, *(space.shape or ())])
        dtype = _onnx_type(space.dtype)
        if isinstance(space, Box):
            x = self.then("Reshape", self.then("Cast", x, to=dtype), shape)
            x = self.then("Max", x, space.low[None])
            return self.then("Min", x, space.high[None], out="action")
        if real:
            x = self.then("Cast", x, to=_onnx_type(np.float32))
            x = self.then("Add", x, "noise.0") if noisy else x
            x = self.chosen(x, space, masked)
        return self.then("Cast", self.then("Reshape", x, shape), to=dtype, out="action")

    def chosen(self, x: str, space: Any, masked: bool) -> str:
        """Add the choice of the best by logits ``x``; return the name of the choices (1, K)."""
        if isinstance(space, MultiBinary):
            return self.then("Greater", x, np.zeros(1, np.float32))
        if masked:
            x = self.then("Where", "mask", x, np.full((1, 1), -np.inf, np.float32))
        best, first = [], 0
        for n in action_codec(space).parts:
            part = self.then("Gather", x, np.arange(first, first + n), axis=1)
            best.append(self.then("ArgMax", part, axis=1, keepdims=1))
            first += n
        joined = self.then("Concat", *best, axis=1)
        return self.then("Add", joined, _start(space).reshape(1, -1))


def _start(space: Any) -> Array:
    """Return the first choice of each part, in the shape of an action."""
    return np.asarray(space.start, np.int64)


def _choices(policy: Any) -> int:
    """Return the width of the mask; 0: there is none."""
    space = policy.action_space
    return 0 if isinstance(space, Box | MultiBinary) else action_codec(space).size


def _noise(policy: Any, sampled: bool) -> tuple[tuple[str, int], ...]:
    """Return the noise inputs that logits are sampled with."""
    space = policy.action_space
    if not sampled or isinstance(space, Box):
        return ()
    if isinstance(space, MultiBinary):  # one logit for each bit
        return (("logistic", int(np.prod(space.shape))),)
    return (("gumbel", action_codec(space).size),)
