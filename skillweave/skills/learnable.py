"""Policies made elsewhere that a skill begins to learn with: their networks, as data."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box

from skillweave.errors import DeclarationError, PolicyError
from skillweave.policies.core import Array
from skillweave.skills.goal_spaces import goal_part, other_goals

if TYPE_CHECKING:
    from torch import nn

ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "SiLU": "silu", "GELU": "gelu"}
"""Names of a network's nonlinearity, by torch's class."""
PLAIN_PPO = {"squash_actions": False, "action_std": "parameter"}
"""Settings of PPO whose actor is a plain network of means, or of logits."""


def learn_on(skill: str) -> str:
    """Return words on the way in which a skill with a ready policy can learn on."""
    return (
        "write policy = from_sb3(..., learn=True), or from_torch's, if it is a network from "
        "elsewhere; policy = Residual(policy) to learn a correction of its actions; if it is a "
        f"skill of another run, leave out policy and call train(start_from={{{skill!r}: run}})"
    )


def no_mapping(who: str, given: str) -> str:
    """Return the message for a policy that is to learn on, and has a mapping."""
    return (
        f"{who} learns on with the skill's observations and actions: leave out {given}. The parts "
        "that it sees and writes are those of the skill's class, which learn on with it: write "
        "sees = ... and acts = ... there"
    )


@dataclass(frozen=True, eq=False)
class Layers:
    """Linear layers with one nonlinearity between them."""

    weights: tuple[Array, ...]  # (in, out) each
    biases: tuple[Array, ...]  # (out,) each
    activation: str

    @property
    def hidden(self) -> tuple[int, ...]:
        """The width of each hidden layer."""
        return tuple(bias.size for bias in self.biases[:-1])

    def named(self, prefix: str) -> dict[str, Array]:
        """Return the arrays as those of a network with the ``prefix``."""
        found: dict[str, Array] = {}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            found[f"{prefix}.{i}.weight"] = weight
            found[f"{prefix}.{i}.bias"] = bias[None]
        return found

    def beside(self, other: Layers) -> Layers:
        """Return layers with the outputs of two that share all layers but the last."""
        weight = np.concatenate([self.weights[-1], other.weights[-1]], axis=1)
        bias = np.concatenate([self.biases[-1], other.biases[-1]])
        return replace(self, weights=(*self.weights[:-1], weight), biases=(*self.biases[:-1], bias))

    def scaled(self, scale: Array, offset: Array) -> Layers:
        """Return layers whose outputs are ``(output - offset) / scale``."""
        last = self.weights[-1] / scale, (self.biases[-1] - offset) / scale
        return replace(
            self, weights=(*self.weights[:-1], last[0]), biases=(*self.biases[:-1], last[1])
        )


@dataclass(frozen=True, eq=False)
class Learnable:
    """The networks of a policy made elsewhere: a skill with this ``policy`` learns on from them.

    Args:
        name: of the policy, in messages.
        kind: the name of the algorithm that learns on.
        networks: by their names in that algorithm: the policy's first; "critic", if it has one.
        log_std: (A,), the log deviation in the environment's units, if it is a parameter.
        env_units: the policy's outputs are actions in the environment's units; else in [−1, 1].
        scaling: mean and variance of observations, (O,) each, and the number of observations.
        observation_space: None: the environment's.
        action_space: None: the environment's.
        settings: of the algorithm, which the networks need.
    """

    name: str
    kind: str
    networks: Mapping[str, Layers]
    log_std: Array | None = None
    env_units: bool = False
    scaling: tuple[Array, Array, float] | None = None
    observation_space: Space[Any] | None = None
    action_space: Space[Any] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<{self.name}, to learn on>"

    def __str__(self) -> str:
        return self.name

    @property
    def steps(self) -> int:
        """The number of observations behind ``scaling``; 0: there is none."""
        return 0 if self.scaling is None else int(self.scaling[2])

    def learning_on(self, config: Any, who: str) -> Any:
        """Return the settings ``config`` of an algorithm with the networks of this policy.

        Raises:
            DeclarationError: the algorithm cannot learn on with it; ``who`` begins the message.
        """
        if (kind := type(config).__name__) != self.kind:
            raise DeclarationError(
                f"{who}: {self.name} learns on by {self.kind}, but the algorithm is {kind}: write "
                f"algorithm = sw.{self.kind}(...)"
            )
        nets = self.networks.values()
        shapes = [{"hidden": net.hidden, "activation": net.activation} for net in nets]
        changes: dict[str, Any] = {
            "network": shapes[0],
            "normalize_obs": self.scaling is not None,
        }
        if "critic" in self.networks:
            changes["critic"] = shapes[-1]
        return replace(config, **changes, **self.settings)

    def check(
        self,
        observation_space: Space[Any],
        action_space: Space[Any],
        goal_space: Space[Any] | None,
        who: str,
    ) -> None:
        """Raise a PolicyError where these are not the spaces that the policy was made for.

        Args:
            observation_space: with the goal, where the skill has goals.
            action_space: of actions.
            goal_space: of the skill; None: it has no goals.
            who: begins messages.
        """
        from skillweave.spaces import same_space

        for what, mine, theirs in (
            ("observation_space", self.observation_space, observation_space),
            ("action_space", self.action_space, action_space),
        ):
            if mine is not None and not same_space(mine, theirs):
                raise PolicyError(
                    f"{who}: {self.name} has {what} {mine}, but the environment has {theirs}"
                )
        if self.observation_space is None or goal_space is None:
            return
        if says := other_goals(goal_part(self.observation_space), goal_space):
            raise PolicyError(f"{who}: {self.name} {says}")

    @property
    def sizes(self) -> str:
        """Return the numbers of inputs and outputs of each network, for messages."""
        each = ((name, net.weights) for name, net in self.networks.items())
        return ", ".join(f"{k} {w[0].shape[-2]} to {w[-1].shape[-1]}" for k, w in each)

    def weights(self, action_space: Space[Any]) -> dict[str, Array]:
        """Return the arrays by the names of the algorithm's weights, float32."""
        from skillweave.spaces import action_codec

        networks = dict(self.networks)
        log_std = self.log_std
        if self.env_units and isinstance(action_space, Box):
            low, span, bounded = action_codec(action_space).span
            half = np.where(bounded, 0.5 * np.where(span > 0, span, 1.0), 1.0)
            first = next(iter(networks))
            networks[first] = networks[first].scaled(half, np.where(bounded, low + half, 0.0))
            log_std = None if log_std is None else log_std - np.log(half)
        found: dict[str, Array] = {}
        for name, net in networks.items():
            found |= net.named(name)
        if log_std is not None:
            found["actor.log_std"] = log_std[None]
        if self.scaling is not None:
            found |= {"obs_mean": self.scaling[0], "obs_var": self.scaling[1]}
        return {name: np.asarray(value, np.float32) for name, value in found.items()}

    def sha256(self) -> str:
        """Return a checksum of its numbers."""
        digest = hashlib.sha256(self.kind.encode())
        arrays = [x for net in self.networks.values() for x in (*net.weights, *net.biases)]
        arrays += [] if self.log_std is None else [self.log_std]
        arrays += [] if self.scaling is None else list(self.scaling[:2])
        for array in arrays:
            digest.update(np.ascontiguousarray(array, np.float32).tobytes())
        return digest.hexdigest()


def layers_of(modules: Sequence[nn.Module], who: str) -> Layers:
    """Return torch's linear layers and the nonlinearities between them.

    Args:
        modules: a ``Sequential``'s, in their order; ``Flatten`` and ``Identity`` do nothing.
        who: the start of messages.

    Raises:
        PolicyError: there is another kind of layer, or the nonlinearities differ.
    """
    flat = [m for module in modules for m in _unpacked(module)]
    names = [type(m).__name__ for m in flat]
    wrong = next((n for n in names if n != "Linear" and n not in ACTIVATIONS), None)
    usual = {"alpha": 1.0, "approximate": "none"}  # as networks here have them
    other = (repr(m) for m in flat if any(getattr(m, k, v) != v for k, v in usual.items()))
    wrong = wrong or next(other, None)
    kinds = set(names[1::2])
    alternates = set(names[::2]) == {"Linear"} and "Linear" not in kinds and len(names) % 2 == 1
    if wrong or not alternates or len(kinds) > 1:
        found = f"it has a layer {wrong}" if wrong else f"its layers are {', '.join(names)}"
        raise PolicyError(
            f"{who} cannot learn on: {found}, and only linear layers with one kind of nonlinearity "
            f"between them ({', '.join(ACTIVATIONS)}) are known. Let it act as it is (without "
            "learn=True), or use its first layers as an encoder: Network(encoder=function)"
        )
    linear: list[Any] = flat[::2]
    weights = tuple(array_of(m.weight).T for m in linear)
    biases = tuple(np.zeros(m.out_features) if m.bias is None else array_of(m.bias) for m in linear)
    if not all(np.isfinite(x).all() for x in (*weights, *biases)):
        raise PolicyError(f"{who} cannot learn on: its weights hold NaN or infinity")
    return Layers(weights, biases, ACTIVATIONS[kinds.pop()] if kinds else "tanh")


def _unpacked(module: nn.Module) -> list[nn.Module]:
    name = type(module).__name__
    if name == "Sequential":
        return [inner for child in module.children() for inner in _unpacked(child)]
    return [] if name in ("Flatten", "Identity") else [module]


def array_of(tensor: Any) -> Array:
    """Return a tensor's numbers, float64."""
    array: Array = tensor.detach().cpu().double().numpy()
    return array
