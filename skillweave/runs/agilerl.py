"""Checkpoints of AgileRL 0.1 and 1.0 (PPO, DQN, DDPG, TD3 with MLPs) as files of native agents."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor

from skillweave.algorithms.config import DQN, PPO, TD3
from skillweave.algorithms.policy import make_algorithm
from skillweave.networks.config import CNN, Network
from skillweave.networks.stacked import Views
from skillweave.runs.agents import save_agent
from skillweave.runs.pickles import read_torch_pickle
from skillweave.seeding import Seeds
from skillweave.types import SkillweaveError

_KINDS: dict[str, Any] = {"PPO": PPO, "DQN": DQN, "DDPG": TD3, "TD3": TD3}
_OUTPUTS = {"PPO": "Softmax", "DQN": None, "DDPG": "Tanh", "TD3": "Tanh"}
ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "SiLU": "silu", "GELU": "gelu"}
_LAYER = re.compile(r"(linear_layer|layer_norm)_(\d+|output)\.(weight|bias)$")


def convert(path: Path, out: Path) -> str:
    """Write a checkpoint of AgileRL's as a native agent; the algorithm's name.

    The pickle is read without running code from it (see ``pickles``). The optimiser begins anew.

    Raises:
        SkillweaveError: the file is missing, names what is refused, is no checkpoint of
            AgileRL's, or holds what no native policy computes; the message says what.
    """
    data = read_torch_pickle(path)
    algo = data.get("algo") if isinstance(data, dict) else None
    if algo not in _KINDS or "actor_state_dict" not in data or "actor_init_dict" not in data:
        raise SkillweaveError(
            f"{path} holds no agent that can be converted (algorithm {algo!r}): it must be a "
            f"checkpoint of AgileRL 0.1 or 1.0 of {', '.join(_KINDS)}"
        )
    init = data["actor_init_dict"]
    output = init.get("mlp_output_activation")
    if "num_inputs" not in init or output != _OUTPUTS[algo]:
        kind = f"an MLP that ends in {output}" if "num_inputs" in init else "a CNN, or its own"
        raise SkillweaveError(
            f"{path}: the actor is {kind}; of {algo} only MLPs that end in {_OUTPUTS[algo]} can "
            "be converted: no native policy computes the same as others"
        )
    try:
        algorithm, state = _agent(algo, data)
    except SkillweaveError as error:
        raise SkillweaveError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise SkillweaveError(f"{path}: its networks are not as it describes: {error!r}") from error
    past = {k: [float(x) for x in data.get(k, ())] for k in ("scores", "fitness")}
    steps = [int(x) for x in data.get("steps", (0,))]
    about = {"algo": algo, **past, "steps": steps, "index": int(data.get("index", 0)), "mut": None}
    save_agent(out, algorithm, state, about)
    return str(algo)


def _agent(algo: str, data: Mapping[str, Any]) -> tuple[Any, Any]:
    kind, actor = _KINDS[algo], data["actor_init_dict"]
    critics = [data[k] for k in ("critic_state_dict", "critic_1_state_dict") if k in data]
    critics += [data[k] for k in ("critic_2_state_dict",) if k in data]
    own = {f.name for f in fields(kind)}
    known = {k: v for k, v in data.items() if k in own and type(v) in (int, float, bool)}
    rate = data.get("lr", data.get("lr_critic", 1e-3))
    config: dict[str, Any] = {**known, "learning_rate": float(rate), "network": _mlp(actor)}
    if kind is PPO:
        config |= {"learning_rate_schedule": "constant", "num_envs": 1, "n_steps": 2**31}
    config["normalize_obs"] = False  # AgileRL does not
    if "learn_step" in data and kind is not PPO:
        config["update_ratio"] = 1.0 / data["learn_step"]
    if kind is TD3:
        config |= {"twin": algo == "TD3", "policy_delay": int(data.get("policy_freq", 2))}
        config["actor_rate"] = float(data.get("lr_actor", rate)) / float(rate)
    if kind is not DQN:
        config["critic"] = _mlp(data.get("critic_init_dict") or data["critic_1_init_dict"])
    algorithm: Any = make_algorithm(kind(**config), *_spaces(kind, data))
    state = algorithm.init([Seeds(0)])
    views = algorithm.layout.views(state.params)
    _fill(views, "q" if kind is DQN else "actor", data["actor_state_dict"])
    if kind is PPO:
        _fill(views, "critic", critics[0])
    else:
        state.target.copy_(state.params)
    for i, critic in enumerate(critics if kind is TD3 else ()):
        for flat in (state.critic, state.critic_target):
            _fill(algorithm.critics.layout.views(flat[:, i]), "critic", critic)
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
    """The space of what AgileRL calls states of this size, seen by such a network."""
    shape, described = [int(n) for n in np.atleast_1d(size)], net_config or {}
    if one_hot:
        return gym.spaces.Discrete(shape[0])
    if described.get("arch") != "cnn":
        return gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
    if described.get("normalize", True):
        return gym.spaces.Box(0, 255, shape, np.uint8)
    return gym.spaces.Box(0.0, 1.0, shape, np.float32)


def network_of(described: Mapping[str, Any], usual: str | None = None) -> Network:
    """What AgileRL describes by a ``net_config``.

    Raises:
        SkillweaveError: a part is missing or unknown.
    """
    name = described.get("mlp_activation") or described.get("activation") or usual
    known = described.get("arch") in ("mlp", "cnn") and name in ACTIVATIONS
    if not known or "hidden_size" not in described:
        raise SkillweaveError(
            f"a network is described by {dict(described)}; it must have a hidden_size, arch be "
            f"'mlp' or 'cnn', and its activation be one of {', '.join(ACTIVATIONS)}"
        )
    sizes = [tuple(described.get(f"{k}_size", ())) for k in ("channel", "kernel", "stride")]
    cnn, hidden = CNN("plain", *sizes) if sizes[0] else None, described["hidden_size"]
    layer_norm, activation = bool(described.get("layer_norm")), ACTIVATIONS[str(name)]
    return Network(tuple(int(n) for n in hidden), activation, layer_norm, cnn)  # type: ignore[arg-type]


def _fill(views: Views, prefix: str, weights: Mapping[str, Tensor]) -> None:
    """Write a state dict into the views of one network, all of it."""
    left = {k for k in views if k.startswith(f"{prefix}.")}
    depth = max(int(k.split(".")[1]) for k in left)
    for key, value in weights.items():
        if (found := _LAYER.search(key)) is None:
            raise ValueError(f"unknown weights {key}")
        layer, number, what = found.groups()
        name = f"norm_{what}" if layer == "layer_norm" else what
        name = f"{prefix}.{depth if number == 'output' else number}.{name}"
        value = value.t() if layer == "linear_layer" else value
        if views[name][0].numel() != value.numel():
            raise ValueError(f"{key} has the shape {tuple(value.shape)}")
        views[name].copy_(value.reshape(views[name].shape))
        left.discard(name)
    if left:
        raise ValueError(f"no weights for {', '.join(sorted(left))}")
