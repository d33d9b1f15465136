"""Convert checkpoints of AgileRL 0.1 and 1.0 (PPO, DQN, DDPG, TD3 with MLPs) to native agents."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.compat.agilerl.agent import AgilerlAgent, network_of, observations_of
from skillweave.compat.agilerl.agent_classes import DQN, KINDS, PPO, TD3
from skillweave.compat.pickles import read_torch_pickle
from skillweave.errors import RunError, SkillweaveError
from skillweave.evolution.stacks import Member
from skillweave.networks.config import Network
from skillweave.policies.untrusted import shown
from skillweave.schema import AtLeastOne, Check, fit

_OUTPUTS = {"PPO": "Softmax", "DQN": None, "DDPG": "Tanh", "TD3": "Tanh"}
_LAYER = re.compile(r"(linear_layer|layer_norm)_(\d+|output)\.(weight|bias)$")


def convert(path: Path, out: Path) -> str:
    """Write an AgileRL checkpoint as a native agent; return the name of the algorithm.

    The pickle is read without running code from it (see ``pickles``). The optimiser starts fresh.

    Raises:
        RunError: the file is missing, contains a refused object, is not a checkpoint of AgileRL, or
            describes a policy that does not exist here; the message names it.
    """
    data = read_torch_pickle(path)
    algo: Any = data.get("algo") if isinstance(data, dict) else None
    known = isinstance(algo, str) and algo in _OUTPUTS
    if not known or "actor_state_dict" not in data or "actor_init_dict" not in data:
        raise RunError(
            f"{path} holds no agent that can be converted (algorithm {shown(algo)}): it must be a "
            f"checkpoint of AgileRL 0.1 or 1.0 of {', '.join(_OUTPUTS)}"
        )
    fit(_Checkpoint, data, str(path))
    init = data["actor_init_dict"]
    output = init.get("mlp_output_activation")
    if "num_inputs" not in init or output != _OUTPUTS[algo]:
        kind = f"an MLP that ends in {output}" if "num_inputs" in init else "a CNN, or its own"
        raise RunError(
            f"{path}: the actor is {kind}; of {algo} only MLPs that end in {_OUTPUTS[algo]} can "
            "be converted: no native policy computes the same as others"
        )
    try:
        agent = _agent(KINDS[algo], data)
    except SkillweaveError as error:
        raise RunError(f"{path}: {error}") from error
    except (LookupError, TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {str(error)[:300]}"
        raise RunError(f"{path}: its networks are not as it describes: {reason}") from error
    agent.saveCheckpoint(out)
    return agent.algo


_MOST_UNITS = 10**6
_Units = Annotated[int, Check("between 1 and a million", lambda n: 1 <= n <= _MOST_UNITS)]


def _is_size(data: Any) -> bool:
    sizes = data if isinstance(data, list | tuple) else [data]
    return all(type(n) is int and n >= 1 for n in sizes) and math.prod(sizes) <= _MOST_UNITS


class _Init(TypedDict):
    """The description of an MLP, as AgileRL writes it."""

    num_inputs: NotRequired[Annotated[Any, Check("sizes, a million in all at most", _is_size)]]
    num_outputs: NotRequired[_Units]
    hidden_size: NotRequired[list[_Units]]
    mlp_output_activation: NotRequired[str | None]


class _Checkpoint(TypedDict):
    """The fields of a checkpoint that are read, besides hyperparameters named as ours."""

    actor_init_dict: _Init
    actor_state_dict: dict[str, Any]
    critic_init_dict: NotRequired[_Init]
    critic_state_dict: NotRequired[dict[str, Any]]
    critic_1_init_dict: NotRequired[_Init]
    critic_1_state_dict: NotRequired[dict[str, Any]]
    critic_2_state_dict: NotRequired[dict[str, Any]]
    one_hot: NotRequired[bool | None]
    scores: NotRequired[list[float]]
    fitness: NotRequired[list[float]]
    steps: NotRequired[list[float]]
    index: NotRequired[int]
    lr: NotRequired[float]
    lr_actor: NotRequired[float]
    lr_critic: NotRequired[float]
    learn_step: NotRequired[AtLeastOne]
    policy_freq: NotRequired[AtLeastOne]


def _agent(kind: Any, data: Mapping[str, Any]) -> AgilerlAgent:
    """Return the agent that a checkpoint describes."""
    actor = data["actor_init_dict"]
    critics = [data[k] for k in ("critic_state_dict", "critic_1_state_dict") if k in data]
    critics += [data[k] for k in ("critic_2_state_dict",) if k in data]
    rate = data.get("lr", data.get("lr_critic", 1e-3))
    given = {k: v for k, v in data.items() if type(v) in (int, float, bool)}
    given |= {"lr": float(rate), "lr_critic": float(rate)}
    settings: dict[str, Any] = {"network": _mlp(actor)}
    outputs = int(actor["num_outputs"])
    actions: gym.Space[Any] = gym.spaces.Discrete(outputs)
    if kind is not DQN:
        settings["critic"] = _mlp(data.get("critic_init_dict") or data["critic_1_init_dict"])
    if issubclass(kind, TD3):
        settings["exploration_noise"] = 0.1
        settings["actor_rate"] = float(data.get("lr_actor", rate)) / float(rate)
        low, high = (np.broadcast_to(data[k], outputs) for k in ("min_action", "max_action"))
        actions = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32))
    spaces = observations_of(actor["num_inputs"], data.get("one_hot"), actor), actions
    algorithm: Any = make_algorithm(kind.config_of(given, **settings), *spaces)
    shapes = algorithm.layout.shapes
    weights = _named(shapes, "q" if kind is DQN else "actor", data["actor_state_dict"])
    if kind is PPO:
        weights |= _named(shapes, "critic", critics[0])
    apart = critics if issubclass(kind, TD3) else []
    valued = [_named(algorithm.critics.layout.shapes, "critic", critic) for critic in apart]
    state = algorithm.init([Seeds(0)])  # not before: the file has weights of the described sizes
    algorithm.set_weights(state, weights)
    for i, named in enumerate(valued):
        for flat in (state.critic, state.critic_target):
            for name, view in algorithm.critics.layout.views(flat[:, i]).items():
                view[0].copy_(named[name])
    agent: AgilerlAgent = kind.__new__(kind)
    agent.take(Member(0, algorithm.config, state), spaces, Seeds(0))
    agent.scores, agent.fitness = (
        [float(x) for x in data.get(k, ())] for k in ("scores", "fitness")
    )
    agent.steps = [int(x) for x in data.get("steps", (0,))]
    agent.index = data.get("index", 0)
    return agent


def _mlp(init: Mapping[str, Any]) -> Network:
    return network_of({"arch": "mlp", **init})  # an ``*_init_dict`` leaves it unsaid


def _named(
    shapes: Mapping[str, tuple[int, ...]], prefix: str, weights: Mapping[str, Any]
) -> dict[str, Tensor]:
    """Return a state dict with the names and shapes of one of our networks, complete.

    Raises:
        RunError: a weight is missing, unknown, of another shape, or not finite.
    """
    expected = {k: shape for k, shape in shapes.items() if k.startswith(f"{prefix}.")}
    depth = max(int(k.split(".")[1]) for k in expected)
    named: dict[str, Tensor] = {}
    for key, value in weights.items():
        where = f"{prefix}_state_dict: {key[:100]}"
        if (match := _LAYER.search(key)) is None or not isinstance(value, Tensor):
            raise RunError(f"{where} is no weights of an MLP: unknown weights {key[:100]}")
        layer, number, what = match.groups()
        matrix = layer == "linear_layer" and what == "weight"
        name = f"norm_{what}" if layer == "layer_norm" else what
        name = f"{prefix}.{depth if number == 'output' else int(number)}.{name}"
        if name not in expected or name in named:
            raise RunError(f"{where} belongs to no layer that is described")
        # Stored as torch has it: (out, in), where ours is (in, out).
        expected_shape = expected[name][::-1] if matrix else expected[name][-1:]
        if tuple(value.shape) != expected_shape:
            raise RunError(
                f"{where} has the shape {tuple(value.shape)}, but {expected_shape} is described"
            )
        value = value.to(torch.float32) if value.is_floating_point() else value
        if value.dtype != torch.float32 or not value.isfinite().all():
            raise RunError(f"{where} holds NaN, infinity, or no real numbers")
        named[name] = (value.t() if matrix else value).reshape(expected[name])
    if left := sorted(set(expected) - set(named)):
        raise RunError(f"there are no weights for {', '.join(left)}")
    return named
