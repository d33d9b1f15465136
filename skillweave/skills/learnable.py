"""Policies made elsewhere that a skill begins to learn with: their networks, as data."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box

from skillweave.errors import DeclarationError, PolicyError
from skillweave.policies.core import Array
from skillweave.policies.untrusted import checksum
from skillweave.schema import fitted
from skillweave.skills.goal_spaces import goal_part, other_goals
from skillweave.skills.mapping import Elapsed, LastAction, PolicyMapping, Table

if TYPE_CHECKING:
    from torch import nn

ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "SiLU": "silu", "GELU": "gelu"}
"""Names of a network's nonlinearity, by torch's class."""
PLAIN_PPO = {"squash_actions": False, "action_std": "parameter"}
"""Settings of PPO whose actor is a plain network of means, or of logits."""


def learn_on(skill: str) -> str:
    """Return words on the way in which a skill with a ready policy can learn on."""
    return (
        "write policy = from_sb3(..., learn=True), from_onnx's or from_torch's, if it is a network "
        "from elsewhere; policy = Residual(policy) to learn a correction of its actions; if it is "
        f"a skill of another run, leave out policy and call train(start_from={{{skill!r}: run}})"
    )


def no_mapping(who: str, given: str) -> str:
    """Return the message for a policy that is to learn on, and has a mapping."""
    return (
        f"{who} learns on with the skill's observations and actions: leave out {given}. The parts "
        "that it sees and writes are those of the skill's class, which learn on with it: write "
        "sees = ... and acts = ... there"
    )


def _sees(kind: type[Any], mapping: PolicyMapping) -> bool:
    """Return whether an input of a mapping has a source of a kind."""
    return any(isinstance(source, kind) for source in mapping.sources())


REFUSED: tuple[tuple[str, Callable[[PolicyMapping], bool], str], ...] = (
    (
        "sees has LastAction()",
        partial(_sees, LastAction),
        "let the environment observe its last action, and read it, Part('last_action')",
    ),
    *(
        (
            f"sees has {kind.__name__}",
            partial(_sees, kind),
            "let the environment observe the time, and read it, Part('time')",
        )
        for kind in (Elapsed, Table)
    ),
    (
        "sees has history",
        lambda x: any(getattr(source, "history", 1) > 1 for source in x.sources()),
        "let the environment observe its past, by a wrapper, and read it as a Part",
    ),
    (
        "sees has a function with call, or entry is given",
        lambda x: x.timed,
        "let the environment observe the time since the skill took over, and read it as a Part",
    ),
    ("every is given", lambda x: x.every > 1, "let the environment repeat an action"),
    ("chunk is given", lambda x: x.chunk is not None, "let it learn a correction, Residual(...)"),
    ("state is given", lambda x: bool(x.state), "let it learn a correction, Residual(...)"),
    ("anew is given", lambda x: bool(x.anew), "it has nothing to begin anew: leave out anew"),
    (
        "acts has ramp",
        lambda x: x.acts is not None and x.acts.ramp > 0,
        "it learns to take over from another skill: leave out ramp",
    ),
    (
        "acts has to or rest",
        lambda x: x.acts is not None and (x.acts.to is not None or x.acts.rest is not None),
        "it writes all numbers of the action, in their order: let the environment, or a wrapper, "
        "take the policy's numbers alone",
    ),
)
"""What the mapping of a file that learns on cannot have, as it acts by what it sees alone: words on
it, a test, and advice."""


def check_learns_on(mapping: PolicyMapping, who: str) -> None:
    """Raise a DeclarationError where a mapping has what a file that learns on cannot have."""
    for given, holds, advice in REFUSED:
        if holds(mapping):
            raise DeclarationError(
                f"{who}: {given}, but a policy that learns on has no time or memory of its own, "
                f"and writes whole actions: {advice}"
            )


@dataclass(frozen=True, eq=False)
class NetworkFile:
    """A file whose network learns on, and the meaning of its input and output.

    The skill's own part is the file's: it observes the network's input and acts by its output.
    """

    name: str
    """The path of the file."""
    output: str
    """The name of the output in it."""
    input: str
    """The name of the input, and below its shape for one environment; None: any number."""
    shape: tuple[int | None, ...]
    squashes: bool
    """The output is that of a last ``Tanh``."""
    mapping: PolicyMapping
    """Its mapping; ``scaling`` has the normalisation in the file."""
    content: bytes = b""
    """The whole file; empty: of a run that was loaded without its code."""

    def to_json(self) -> dict[str, Any]:
        """Return all but the content as JSON, for runs."""
        fields: dict[str, Any] = {
            "output": self.output,
            "input": self.input,
            "shape": list(self.shape),
            "mapping": self.mapping.to_json(),
        }
        return fields | ({"squashes": True} if self.squashes else {})

    @classmethod
    def from_json(cls, data: Any) -> NetworkFile:
        """Return a file, without its content, as ``to_json`` wrote it.

        Raises:
            DeclarationError: a value is wrong, or needs a function.
        """
        fitted(Mapping[str, Any], data, "learns_on")
        output = fitted(str, data.get("output"), "learns_on.output")
        source = fitted(str, data.get("input"), "learns_on.input")
        shape = fitted(tuple[int | None, ...], data.get("shape"), "learns_on.shape")
        squashes = fitted(bool, data.get("squashes", False), "learns_on.squashes")
        mapping = PolicyMapping.from_json(data.get("mapping"))
        return cls("its file", output, source, shape, squashes, mapping)

    def source(self) -> dict[str, Any]:
        """Return the fields of its ``Source``."""
        sha256 = {"sha256": checksum(self.content)} if self.content else {}
        return {"kind": "onnx", "name": self.name, "file": self.name, **sha256}


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

    def first(self, weight: Array, bias: Array) -> Layers:
        """Return layers with another first one."""
        return replace(self, weights=(weight, *self.weights[1:]), biases=(bias, *self.biases[1:]))

    def scaled(self, scale: Array, offset: Array) -> Layers:
        """Return layers whose outputs are ``(output - offset) / scale``."""
        last = self.weights[-1] / scale, (self.biases[-1] - offset) / scale
        return replace(
            self, weights=(*self.weights[:-1], last[0]), biases=(*self.biases[:-1], last[1])
        )


@dataclass(frozen=True, eq=False)
class GoalColumns:
    """The goal among the inputs of a file's network; the learner has it last, or not at all.

    A goal that never changes is no input of the learner: it is part of the first layer's bias. The
    goal of a call comes after all other inputs, as it is; its scaling is part of the first layer.
    """

    places: Array
    """(G,) its places in the file's input."""
    scale: Array
    """(G,) the input there is ``goal * scale + shift``."""
    shift: Array
    """(G,)"""
    fixed: Array | None = None
    """(G,) the input there, of a goal that never changes; None: each call has a goal."""

    def fold(self, layers: Layers) -> Layers:
        """Return the layers of the learner for those of the file."""
        weight = layers.weights[0]
        own, bias = np.delete(weight, self.places, axis=0), layers.biases[0]
        goal = weight[self.places]
        if self.fixed is not None:
            return layers.first(own, bias + self.fixed @ goal)
        joint = np.concatenate([own, goal * self.scale[:, None]])
        return layers.first(joint, bias + self.shift @ goal)

    def unfold(self, layers: Layers, before: Layers) -> Layers:
        """Return the layers of the file for those of the learner, the inverse of ``fold``.

        Args:
            layers: of the learner.
            before: of the file, whose weights stay where nothing was learnt.
        """
        weight = before.weights[0].copy()
        learnt, bias = layers.weights[0], layers.biases[0]
        others = np.delete(np.arange(len(weight)), self.places)
        weight[others] = learnt[: len(others)]
        if self.fixed is not None:
            return layers.first(weight, bias - self.fixed @ weight[self.places])
        counts = self.scale != 0.0
        goal = learnt[len(others) :][counts] / self.scale[counts][:, None]
        weight[self.places[counts]] = goal
        return layers.first(weight, bias - self.shift @ weight[self.places])


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
        file: the file that the policy was read from, with its mapping; None: it has no mapping.
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
    file: NetworkFile | None = None

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
        if not nets:  # of a run that was loaded without its code, and has learnt
            return config
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

        if self.file is not None:  # its own part checks them
            return
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

    def weights(
        self, action_space: Space[Any], goal: GoalColumns | None = None
    ) -> dict[str, Array]:
        """Return the arrays by the names of the algorithm's weights, float32.

        Args:
            action_space: of the learner's actions.
            goal: the goal in the input of a file's network; None: it has none.
        """
        from skillweave.spaces import action_codec

        networks = dict(self.networks)
        if goal is not None:
            first = next(iter(networks))
            networks[first] = goal.fold(networks[first])
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
