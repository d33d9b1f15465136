"""Convert checkpoints of AgileRL 0.1 and 1.0 (PPO, DQN, DDPG, TD3 with MLPs) to native agents."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.config import DQN, PPO, TD3
from skillweave.algorithms.policy import make_algorithm
from skillweave.compat.pickles import read_torch_pickle
from skillweave.compat.single_agent import save_agent
from skillweave.errors import RunError, SkillweaveError
from skillweave.networks.config import CNN, Network
from skillweave.networks.stacked import Views
from skillweave.policies.files import shown
from skillweave.schema import AtLeastOne, Check, fit

_KINDS: dict[str, Any] = {"PPO": PPO, "DQN": DQN, "DDPG": TD3, "TD3": TD3}
_OUTPUTS = {"PPO": "Softmax", "DQN": None, "DDPG": "Tanh", "TD3": "Tanh"}
ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "SiLU": "silu", "GELU": "gelu"}
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
    known = isinstance(algo, str) and algo in _KINDS
    if not known or "actor_state_dict" not in data or "actor_init_dict" not in data:
        raise RunError(
            f"{path} holds no agent that can be converted (algorithm {shown(algo)}): it must be a "
            f"checkpoint of AgileRL 0.1 or 1.0 of {', '.join(_KINDS)}"
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
        algorithm, state = _agent(algo, data)
        past = {k: [float(x) for x in data.get(k, ())] for k in ("scores", "fitness")}
        steps = [int(x) for x in data.get("steps", (0,))]
    except SkillweaveError as error:
        raise RunError(f"{path}: {error}") from error
    except (LookupError, TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {str(error)[:300]}"
        raise RunError(f"{path}: its networks are not as it describes: {reason}") from error
    about = {"algo": algo, **past, "steps": steps, "index": data.get("index", 0), "mut": None}
    save_agent(out, algorithm, state, about)
    return str(algo)


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


def _agent(algo: str, data: Mapping[str, Any]) -> tuple[Any, Any]:
    kind = _KINDS[algo]
    actor = data["actor_init_dict"]
    critics = [data[k] for k in ("critic_state_dict", "critic_1_state_dict") if k in data]
    critics += [data[k] for k in ("critic_2_state_dict",) if k in data]
    names = {f.name for f in fields(kind)}
    known = {k: v for k, v in data.items() if k in names and type(v) in (int, float, bool)}
    rate = data.get("lr", data.get("lr_critic", 1e-3))
    config: dict[str, Any] = {**known, "learning_rate": float(rate), "network": _mlp(actor)}
    if kind is PPO:
        config |= {"learning_rate_schedule": "constant", "num_envs": 1, "n_steps": 2**31}
        config["min_advantage_std"] = 0.0  # AgileRL has no such limit
    config["normalize_obs"] = False  # AgileRL does not
    if "learn_step" in data and kind is not PPO:
        config["update_ratio"] = 1.0 / data["learn_step"]
    if kind is TD3:
        config |= {"twin": algo == "TD3", "n_step": 1, "exploration_noise": 0.1}
        config |= {"action_l2": 0.0, "policy_delay": int(data.get("policy_freq", 2))}
        config["actor_rate"] = float(data.get("lr_actor", rate)) / float(rate)
    if kind is not DQN:
        config["critic"] = _mlp(data.get("critic_init_dict") or data["critic_1_init_dict"])
    algorithm: Any = make_algorithm(kind(**config), *_spaces(kind, data))
    acting = "q" if kind is DQN else "actor"
    shapes = algorithm.layout.shapes
    weights = _named(shapes, acting, data["actor_state_dict"])
    if kind is PPO:
        weights |= _named(shapes, "critic", critics[0])
    apart = critics if kind is TD3 else []
    valued = [_named(algorithm.critics.layout.shapes, "critic", critic) for critic in apart]
    state = algorithm.init([Seeds(0)])  # not before: the file has weights of the described sizes
    _fill(algorithm.layout.views(state.params), weights)
    if kind is not PPO:
        state.target.copy_(state.params)
    for i, named in enumerate(valued):
        for flat in (state.critic, state.critic_target):
            _fill(algorithm.critics.layout.views(flat[:, i]), named)
    return algorithm, state


def _spaces(kind: type, data: Mapping[str, Any]) -> tuple[gym.Space[Any], gym.Space[Any]]:
    init = data["actor_init_dict"]
    outputs = int(init["num_outputs"])
    seen = observations_of(init["num_inputs"], data.get("one_hot"))
    if kind is not TD3:
        return seen, gym.spaces.Discrete(outputs)
    low, high = (
        np.broadcast_to(data[k], outputs).astype(np.float32) for k in ("min_action", "max_action")
    )
    return seen, gym.spaces.Box(low, high)


def _mlp(init: Mapping[str, Any]) -> Network:
    return network_of({"arch": "mlp", **init})  # an ``*_init_dict`` leaves it unsaid


def observations_of(
    size: Any, one_hot: bool | None, net_config: Mapping[str, Any] | None = None
) -> gym.Space[Any]:
    """Return the observation space of states of this size, for a network of this description."""
    shape = [int(n) for n in np.atleast_1d(size)]
    described = net_config or {}
    if one_hot:
        return gym.spaces.Discrete(shape[0])
    if described.get("arch") != "cnn":
        return gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
    if described.get("normalize", True):
        return gym.spaces.Box(0, 255, shape, np.uint8)
    return gym.spaces.Box(0.0, 1.0, shape, np.float32)


def network_of(described: Mapping[str, Any], usual: str | None = None) -> Network:
    """Return the network that a ``net_config`` of AgileRL describes.

    Raises:
        RunError: a part is missing or unknown.
    """
    name = described.get("mlp_activation") or described.get("activation") or usual
    known = described.get("arch") in ("mlp", "cnn") and name in ACTIVATIONS
    if not known or "hidden_size" not in described:
        raise RunError(
            f"a network is described by {shown(dict(described), 500)}; it must have a hidden_size, "
            f"arch be 'mlp' or 'cnn', and its activation be one of {', '.join(ACTIVATIONS)}"
        )
    sizes = [tuple(described.get(f"{k}_size", ())) for k in ("channel", "kernel", "stride")]
    cnn = CNN("plain", *sizes) if sizes[0] else None
    hidden = described["hidden_size"]
    layer_norm = bool(described.get("layer_norm"))
    activation = ACTIVATIONS[str(name)]
    planes: Any = None if cnn is None else "first"  # the layout of all images in AgileRL
    widths = tuple(int(n) for n in hidden)
    return Network(widths, activation, layer_norm, cnn, planes=planes)  # type: ignore[arg-type]


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


def _fill(views: Views, weights: Mapping[str, Tensor]) -> None:
    for name, value in weights.items():
        views[name][0].copy_(value)
