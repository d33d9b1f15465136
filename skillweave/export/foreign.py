"""Models from elsewhere as ONNX files, beside the mapping that the runner applies around them.

Stands alone because each kind of model is converted in its own way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from skillweave.errors import PolicyError
from skillweave.export.graphs import leaves_of, traced
from skillweave.ops.device import FLOAT
from skillweave.skills.mapped import MappedPolicy, invoke, parted
from skillweave.skills.onnx_file import OnnxPolicy
from skillweave.skills.plan import Plan
from skillweave.skills.sb3 import SB3Policy
from skillweave.skills.torch_module import TorchPolicy
from skillweave.spaces.packing import parts

OBS = "obs"
"""The name of a file's only input, where the model has none."""


@dataclass(frozen=True)
class Model:
    """An ONNX file's content, and the names in it."""

    content: bytes
    only: str
    """The name of the input that a mapping calls ""."""
    output: str
    state: tuple[tuple[str, str, tuple[int, ...]], ...] = ()
    """Inputs, outputs and shapes of the recurrent state of one environment."""


def model_of(policy: MappedPolicy, where: str) -> Model:
    """Return a policy's model as an ONNX file that acts in one environment.

    Raises:
        PolicyError: it cannot be written as ONNX; the message begins with ``where``.
    """
    match policy:
        case OnnxPolicy():
            return Model(policy.data, policy.free[0], policy.output, policy.single_states())
        case TorchPolicy():
            return _module_model(policy, where)
        case SB3Policy():
            return _sb3_model(policy, where)
    raise PolicyError(f"{where} is a {type(policy).__name__}, which cannot be written as ONNX")


def mapping_entry(
    plan: Plan, only: str, name_of: Callable[[Callable[..., Any], str], str]
) -> dict[str, Any]:
    """Return a mapping as JSON for the runner: each part of an input names one leaf.

    Args:
        only: the name of the input that the mapping calls "".
        name_of: returns the runner's name of a user's function; its second argument describes it.
    """
    mapping = plan.mapping
    acts = plan.mapping.acts
    entry = {"goal": None, "acts": None, "scaling": {}, "chunk": None} | mapping.to_json()
    entry |= {"every": mapping.every, "outputs": plan.outputs.count, "sees": None, "shapes": {}}
    what = "observations (1, ...) to numbers (1, ...)"
    names = {id(function): name_of(function, what) for function in mapping.functions().values()}
    if callable(mapping.goal):
        entry["goal"] = {"function": names[id(mapping.goal)]}
    if acts is not None and plan.outputs.to is not None:
        entry["acts"]["to"] = plan.outputs.to.tolist()
    if plan.inputs is not None:
        entry["sees"] = {}
        for name, given in plan.inputs.items():
            entry["sees"][name or only] = given.to_json(names)
            entry["shapes"][name or only] = list(given.shape)
        entry["scaling"] = {name or only: v for name, v in entry["scaling"].items()}
    return entry


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
    """Return the leaves in the structure of the module's input."""
    inner = parts(space)
    if inner is None:
        return next(leaves).to(dtype)
    values = {name: _nested(part, leaves, dtype) for name, part in inner.items()}
    return tuple(values.values()) if isinstance(space, gym.spaces.Tuple) else values


def _examples(policy: MappedPolicy, inputs: Any) -> dict[str, Tensor]:
    """Return one example of each input of a model, by the name in the file."""
    if inputs is None:
        leaves = leaves_of(policy.observation_space)
        return {leaf.name: leaf.example() for leaf in leaves}
    return {name or OBS: torch.zeros(1, *given.shape, **FLOAT) for name, given in inputs.items()}


def _module_model(policy: TorchPolicy, where: str) -> Model:
    inputs = policy.plan.inputs
    given = _examples(policy, inputs)
    shapes = [tuple(1 if n is None else n for n in shape) for shape in policy.mapping.state]
    states = [(f"state.{i}", f"state.{i}.after", shape) for i, shape in enumerate(shapes)]
    given |= {name: torch.zeros(shape, **FLOAT) for name, _, shape in states}
    outputs = ["output", *(after for _, after, _ in states)]
    module = _Called(policy, list(inputs or ()))
    module.training = False  # the policy's module is in evaluation mode already
    return Model(traced(module, given, outputs, where), OBS, "output", tuple(states))


class _Predicting(nn.Module):
    """The policy of a Stable-Baselines3 model, as its ``predict`` acts greedily."""

    def __init__(self, policy: SB3Policy, names: list[str]) -> None:
        super().__init__()
        self.policy = policy.policy
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


def _sb3_model(policy: SB3Policy, where: str) -> Model:
    inputs = policy.plan.inputs
    given = _examples(policy, inputs)
    names = list(inputs or ()) or [name.removeprefix(f"{OBS}.") for name in given]
    module = _Predicting(policy, names).eval()
    # Checks of a distribution's arguments depend on their values, which a graph cannot have.
    checks = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        return Model(traced(module, given, ["output"], where), OBS, "output")
    finally:
        Distribution.set_default_validate_args(checks)
