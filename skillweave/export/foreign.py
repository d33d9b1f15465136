"""Models from elsewhere as ONNX files, behind the mapping that is around them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from skillweave.errors import PolicyError
from skillweave.export.graphs import examples, traced
from skillweave.ops.device import FLOAT
from skillweave.policies.mapped import (
    Function,
    Input,
    Mapped,
    OnnxFile,
    Take,
    invoke,
    parted,
)
from skillweave.policies.spaces import space_of
from skillweave.skills.sb3 import SB3Policy
from skillweave.skills.torch_module import TorchPolicy
from skillweave.spaces.packing import parts

OBS = "obs"
"""The name of a file's only input, where the model has none."""


def as_file(policy: Mapped, where: str, *, sampled: bool) -> Mapped:
    """Return a policy whose model is an ONNX file, or a function.

    Args:
        sampled: it samples; else it is greedy.

    Raises:
        PolicyError: it cannot be written as ONNX; the message begins with ``where``.
    """
    match policy.model:
        case OnnxFile() | Function():
            return policy
        case SB3Policy() as own if not sampled:
            return _sb3_model(policy, own, where)
        case SB3Policy():
            raise PolicyError(
                f"{where} samples by Stable-Baselines3's own code, which the runner does not have: "
                "train with selection=Selection(greedy_skills=True)"
            )
        case TorchPolicy() as own:
            return _module_model(policy, own, where)
    kind = type(policy.model).__name__
    raise PolicyError(f"{where} is a {kind}, which cannot be written as ONNX")


def _with_file(
    policy: Mapped, space: gym.Space[Any], content: bytes, state: tuple[tuple[str, str], ...] = ()
) -> Mapped:
    """Return a policy whose model is a file that was traced on ``_examples``."""
    inputs = policy.inputs
    leaves = space_of(space).leaves
    if inputs is None and () not in leaves:
        whole = {path: Take("observation", leaf.shape, path, whole=True)
                 for path, leaf in leaves.items()}  # fmt: skip
        inputs = {".".join((OBS, *k)): Input((take,), take.shape) for k, take in whole.items()}
    names = tuple(name or OBS for name in inputs or ("",))
    return replace(policy, model=OnnxFile(content, "output", names, state), inputs=inputs)


class _Called(nn.Module):
    """A user's module on one environment, as ``TorchPolicy`` calls it."""

    def __init__(self, policy: TorchPolicy, names: list[str]) -> None:
        super().__init__()
        self.module = policy.module
        self.mapping = policy.mapping
        self.who = policy.name
        self.space = policy.observation_space
        self.names = names
        weights = [*self.module.parameters(), *self.module.buffers()]
        self.dtype = next((x.dtype for x in weights if x.is_floating_point()), torch.float32)

    def forward(self, *given: Tensor) -> Any:
        """Return the output, and the next state; inputs: of the module, then its state."""
        count = len(given) - len(self.mapping.state)
        if self.mapping.sees is None:
            inputs = {"": _nested(self.space, iter(given[:count]), self.dtype)}
        else:
            values = (x.to(self.dtype) for x in given[:count])
            inputs = dict(zip(self.names, values, strict=True))
        state = [x.to(self.dtype) for x in given[count:]]
        value = invoke(self.module, inputs, state, self.mapping.single_state)
        output, after = parted(value, self.mapping, self.who)
        return (output, *after)


def _nested(space: gym.Space[Any], leaves: Iterator[Tensor], dtype: torch.dtype) -> Any:
    """Return the leaves in the structure of the input of an exported module."""
    inner = parts(space)
    if inner is None:
        return next(leaves).to(dtype)
    values = {name: _nested(part, leaves, dtype) for name, part in inner.items()}
    return tuple(values.values()) if isinstance(space, gym.spaces.Tuple) else values


def _examples(policy: Mapped, space: gym.Space[Any]) -> dict[str, Tensor]:
    """Return one example of each input of a model to export, by the name in the file."""
    if policy.inputs is None:
        return examples(space)
    shapes = {name or OBS: given.shape for name, given in policy.inputs.items()}
    return {name: torch.zeros(1, *shape, **FLOAT) for name, shape in shapes.items()}


def _module_model(policy: Mapped, own: TorchPolicy, where: str) -> Mapped:
    """Return the model of a PyTorch module as an ONNX file, with its mapping."""
    if own.buffers:
        raise PolicyError(
            f"{where} keeps its state in buffers ({', '.join(own.buffers)}), which cannot be "
            "written as ONNX: let forward take the state and return the next one"
        )
    space = own.observation_space
    given = _examples(policy, space)
    shapes = [tuple(1 if n is None else n for n in shape) for shape in own.mapping.state]
    state = tuple((f"state.{i}", f"state.{i}.after") for i in range(len(shapes)))
    given |= {k: torch.zeros(shape, **FLOAT) for (k, _), shape in zip(state, shapes, strict=True)}
    outputs = ["output", *(after for _, after in state)]
    module = _Called(own, list(policy.inputs or ()))
    module.training = False  # the policy's module is in evaluation mode already
    return _with_file(policy, space, traced(module, given, outputs, where), state)


class _Predicting(nn.Module):
    """The policy of a Stable-Baselines3 model, as its ``predict`` acts greedily."""

    def __init__(self, policy: SB3Policy, names: list[str]) -> None:
        super().__init__()
        self.policy: Any = policy.module
        self.names = names
        self.space = policy.model_space

    def forward(self, *given: Tensor) -> Tensor:
        """Return the actions in the model's own units."""
        named = dict(zip(self.names, given, strict=True))
        if isinstance(self.space, gym.spaces.Dict):
            obs: Any = {k: _channels_first(named[k], part) for k, part in self.space.items()}
        else:
            obs = _channels_first(next(iter(named.values())), self.space)
        action: Tensor = self.policy._predict(obs, deterministic=True)
        space = self.policy.action_space
        if not isinstance(space, gym.spaces.Box):
            return action.reshape(-1, *(space.shape or ()))
        action = action.reshape(-1, *space.shape)
        low, high = (torch.from_numpy(x) for x in (space.low, space.high))
        if self.policy.squash_output:
            return low + 0.5 * (action + 1.0) * (high - low)
        return action.clamp(low, high)


def _channels_first(x: Tensor, space: gym.Space[Any]) -> Tensor:
    """Return images with their channels where the model has them, as ``predict`` does."""
    shape = tuple(space.shape or ())
    turned = len(shape) == 3 and tuple(x.shape[1:]) == (*shape[1:], shape[0])
    return x.permute(0, 3, 1, 2) if turned and tuple(x.shape[1:]) != shape else x


def _sb3_model(policy: Mapped, own: SB3Policy, where: str) -> Mapped:
    """Return the model of Stable-Baselines3 as an ONNX file, with its mapping."""
    space = own.observation_space
    given = _examples(policy, space)
    names = list(policy.inputs or ()) or [name.removeprefix(f"{OBS}.") for name in given]
    module = _Predicting(own, names).eval()
    # Checks of a distribution's arguments depend on their values, which a graph cannot have.
    checks = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        return _with_file(policy, space, traced(module, given, ["output"], where))
    finally:
        Distribution.set_default_validate_args(checks)
