"""Networks as ONNX graphs: one observation of the environment in, one of its actions out.

The graph is traced from the code that acts here, so both act alike. Scaling of
observations, action masks, memories and the environment's units of actions are in it.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.base import Algorithm
from skillweave.errors import PolicyError, needs_extra
from skillweave.networks.heads import ActionHead, JointHead
from skillweave.ops.device import BOOL, FLOAT
from skillweave.policies.leaves import OnnxNetwork
from skillweave.policies.spaces import space_of
from skillweave.spaces import ActionCodec, ChoiceSpace, JointCodec
from skillweave.spaces.choices import NumberedChoiceCodec

OPSET = 18
"""Version of ONNX's operators."""


def examples(space: gym.Space[Any]) -> dict[str, Tensor]:
    """Return one observation of zeros, by the names of an ONNX graph's inputs."""
    return {
        ".".join(("obs", *path)): torch.from_numpy(np.zeros((1, *leaf.shape), leaf.record))
        for path, leaf in space_of(space).leaves.items()
    }


def mask_width(space: gym.Space[Any]) -> int:
    """Return the number of choices in a mask of actions, 0 where actions have no mask."""
    return space.choices if isinstance(space, ChoiceSpace) else sum(space_of(space).counts)


class _Acting(nn.Module):
    """A trained agent on one observation; inputs: leaves, mask, memory, noise."""

    def __init__(self, policy: AgentPolicy, inputs: OnnxNetwork) -> None:
        super().__init__()
        self.policy = policy
        self.inputs = inputs

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """Return the action in the environment's units, and the new memory if there is one."""
        algorithm = self.policy.algorithm
        left = list(given)
        obs: Any = [left.pop(0)[None] for _ in self.inputs.sees.leaves]
        mask = left.pop(0)[None] if self.inputs.choices else None
        if mask is not None and isinstance(algorithm.codec, NumberedChoiceCodec):
            mask = mask[..., torch.from_numpy(algorithm.codec.number_of_choice)]
        memory = left.pop(0)[None] if self.inputs.memory else None
        noise: Any = left[0][None] if left else None
        if self.inputs.noise and self.inputs.noise[0][0] == "random":
            noise = (noise, left[1] if len(left) > 1 else None)
        elif len(left) > 1:
            noise = torch.cat(left, dim=-1)[None]
        action, _, after = algorithm.act(self.policy.params, obs, mask, noise, memory)
        done = in_env_units(algorithm, action[0])
        return (done,) if after is None else (done, after[0])


class _Worth(nn.Module):
    """The output from which a network's actions are chosen, on one observation."""

    def __init__(self, policy: AgentPolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, *obs: Tensor) -> Tensor:
        """Return the values (1, A)."""
        rows: Any = [x[None] for x in obs]
        _, values, _ = self.policy.algorithm.act(self.policy.params, rows, None, None)
        assert values is not None
        return values[0]


def agent_graph(policy: AgentPolicy, sampled: bool, where: str) -> OnnxNetwork:
    """Return a trained agent as the graph of its network.

    Inputs ``obs…``, ``mask``, ``memory``, ``noise.…``; outputs ``action``, ``memory.after``.

    Args:
        sampled: the graph draws actions from its noise inputs; else it is greedy.

    Raises:
        PolicyError: it cannot be written as ONNX; the message begins with ``where``.
    """
    algorithm = policy.algorithm
    given = examples(policy.observation_space)
    sees, acts = space_of(policy.observation_space), space_of(policy.action_space)
    choices = mask_width(policy.action_space)
    noise = _noise_of(algorithm) if sampled else ()
    graph = OnnxNetwork(b"", sees, acts, choices, algorithm.memory_size, noise)
    if choices:
        given["mask"] = torch.ones(1, choices, **BOOL)
    outputs = ["action"]
    if graph.memory:
        given["memory"] = torch.zeros(1, graph.memory, **FLOAT)
        outputs.append("memory.after")
    given |= {f"noise.{i}": torch.full((1, n), 0.5, **FLOAT) for i, (_, n) in enumerate(noise)}
    return replace(graph, file=traced(_Acting(policy, graph), given, outputs, where))


def worth_graph(critic: AgentPolicy, where: str) -> bytes:
    """Return the ONNX file of a skill critic: inputs ``obs…``, output ``worth``.

    ``worth`` is (1, S), or (1, S + 1) where the critic also has the value of a new decision.
    """
    given = examples(critic.observation_space)
    return traced(_Worth(critic), given, ["worth"], where)


def in_env_units(algorithm: Algorithm, action: Tensor) -> Tensor:
    """Convert an action (1, …) from policy units to the environment's, as ``Algorithm.to_env``.

    One with parts, or a choice of a skill with its goal, becomes a row of numbers (see
    ``Space.flat``).
    """
    codec = algorithm.codec
    head = getattr(algorithm, "head", None)
    if isinstance(codec, NumberedChoiceCodec):
        space: Any = codec.space
        return torch.from_numpy(space.rows(codec.table))[action]
    if not isinstance(head, JointHead):
        return _in_env_units(codec, action, getattr(head, "squash", False))
    return _row(head, action)


def _row(head: ActionHead | JointHead, action: Tensor) -> Tensor:
    """Convert an action (1, …) of a graph with its parts to a row of the environment's numbers."""
    if not isinstance(head, JointHead):
        return _in_env_units(head.codec, action, head.squash).reshape(1, -1).double()
    units = [head.codec.units(action, i) for i in range(len(head.heads))]
    return torch.cat([_row(part, x) for part, x in zip(head.heads, units, strict=True)], dim=1)


def _in_env_units(codec: ActionCodec, action: Tensor, squash: bool) -> Tensor:
    """Convert a policy's action, inside an ONNX graph, to the units of the environment."""
    space = codec.space
    shape = (1, *(space.shape or ()))
    dtype = torch.from_numpy(np.empty(0, space.dtype)).dtype
    if squash:
        action = action.tanh()
    if codec.discrete:
        action = action if codec.low is None else action + torch.from_numpy(np.asarray(codec.low))
        return action.reshape(shape).to(dtype) if codec.multi else action
    assert codec.low is not None
    assert codec.high is not None
    low, span, bounded = codec.span
    wide = np.result_type(np.float32, low)
    shift = torch.from_numpy(np.where(bounded, low, 0).astype(wide))
    width = torch.from_numpy(np.where(bounded, span, 0).astype(wide))
    action = torch.where(action.isnan(), 0.0, action)
    scaled = shift + 0.5 * (action + 1.0) * width
    if not bounded.all():
        scaled = torch.where(torch.from_numpy(bounded), scaled, action.to(scaled.dtype))
    ends = (torch.from_numpy(np.asarray(x)) for x in (codec.low, codec.high))
    return scaled.to(dtype).clamp(*ends).reshape(shape)


def _noise_of(algorithm: Algorithm) -> tuple[Any, ...]:
    """Return the noise that an exported algorithm's ``act`` takes, for one observation."""
    noise = algorithm.noise([torch.Generator()], 1, 1)[0]
    if isinstance(noise, Tensor):
        if isinstance(algorithm.codec, JointCodec):
            return algorithm.head.noises
        kind = "gumbel" if algorithm.codec.discrete else "standard_normal"
        return ((kind, noise.numel()),)
    uniform, normal = noise  # DQN's: of ε, and of the weights
    more = () if normal is None else (("standard_normal", normal.numel()),)
    return (("random", uniform.numel()), *more)


def traced(
    module: nn.Module, given: dict[str, Tensor], outputs: Sequence[str], where: str
) -> bytes:
    """Trace a module and return the content of its ONNX file.

    Raises:
        PolicyError: an operation of it has no counterpart; the message begins with ``where``.
        MissingExtra: the packages that write ONNX are not installed.
    """
    with needs_extra("exporting to ONNX", "onnx"):
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    how: Any = {"input_names": list(given), "output_names": list(outputs), "opset_version": OPSET}
    example = tuple(given.values())
    try:
        with _quiet(), torch.no_grad():
            if any(isinstance(part, torch.jit.ScriptModule) for part in module.modules()):
                # dynamo does not trace TorchScript.
                file: Any = io.BytesIO()
                script = torch.jit.trace(module, example, check_trace=False)
                torch.onnx.export(script, example, file, dynamo=False, **how)
                return bytes(file.getvalue())
            program = torch.onnx.export(module, example, None, dynamo=True, verbose=False, **how)
    except Exception as error:  # torch's own errors have no common class
        raise PolicyError(f"{where} cannot be written as ONNX: {str(error)[:500]}") from error
    assert program is not None
    model = program.model_proto
    model.ClearField("metadata_props")
    _strip(model.graph)
    content: bytes = model.SerializeToString(deterministic=True)
    return content


def _strip(graph: Any) -> None:
    """Forget where an ONNX graph's operations were written: paths, and half of its size."""
    for part in (graph, *graph.node, *graph.value_info):
        part.ClearField("metadata_props")
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                _strip(attribute.g)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence torch's exporter, which reports unneeded packages and prints whole graphs."""
    logger = logging.getLogger("torch")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with (
            warnings.catch_warnings(),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
