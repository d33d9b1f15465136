"""A trained agent as a policy, and as a file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import OBS_STATS, Algorithm
from skillweave.algorithms.config import config_from_json, config_to_json
from skillweave.algorithms.parameters import ParameterGroup
from skillweave.algorithms.registry import make_algorithm
from skillweave.errors import RunError, SkillweaveError
from skillweave.networks.config import Network
from skillweave.networks.net import seen_places
from skillweave.ops.seen import Seen
from skillweave.policies.core import Array, Memory, RowPolicy, Turn
from skillweave.policies.functional import Functional
from skillweave.spaces import pack, space_from_json, space_to_json, to_tensor

S = TypeVar("S")


class AgentPolicy(Functional):
    """A trained agent that acts; a copy, independent of further learning."""

    _seen: Seen | None = None

    def __init__(self, algorithm: Algorithm, weights: dict[str, Tensor]) -> None:
        super().__init__(TrainedNetwork(self), algorithm.observation_space, algorithm.action_space)
        self.algorithm = algorithm
        self.weights = weights
        self.params = algorithm.acting_params_of(weights)

    @classmethod
    def of(cls, algorithm: Algorithm, state: Any, member: int = 0) -> AgentPolicy:
        """Return the policy of one member of a state."""
        return cls(algorithm, algorithm.weights(state, member))

    def name_outliers(self, who: str) -> None:
        """Name observations far beyond those that it learnt from, from now on; see ``Seen``."""
        if self.algorithm.normalize_obs:
            stats = (self.weights[k] for k in OBS_STATS)
            self._seen = Seen(f"{who}: observation number", *stats)

    def look(self, rows: Tensor) -> None:
        """Give a notice of observations (1, n, ...) far beyond those that it learnt from."""
        if self._seen is not None:
            self._seen.look(self.algorithm.obs.split(rows)[0])

    @property
    def seen_places(self) -> tuple[int, ...] | None:
        """The places in the flat observation that its network sees; None: all."""
        network = getattr(self.algorithm.config, "network", None)
        if getattr(network, "sees", None) is None:
            return None
        assert isinstance(network, Network)
        return seen_places(network, self.algorithm.obs)

    @torch.inference_mode()
    def heads(self, obs: Array) -> Array:
        """Return dist_params (n, H) of a network without recurrence: logits, means or values."""
        rows = to_tensor(np.ascontiguousarray(pack(self.observation_space, obs)))[None]
        _, dist_params, _ = self.algorithm.act(self.params, rows, None, None)
        assert dist_params is not None
        array: Array = dist_params[0].numpy()
        return array

    def source(self) -> dict[str, Any]:
        """Return the checksum of spaces and weights, for a run that has this policy as a skill."""
        digest = hashlib.sha256(type(self.algorithm).__name__.encode())
        for space in (self.observation_space, self.action_space):
            digest.update(json.dumps(space_to_json(space), sort_keys=True).encode())
        for name, value in sorted(self.weights.items()):
            digest.update(f"{name}{tuple(value.shape)}".encode())
            digest.update(value.reshape(-1).numpy().data)
        return {"sha256": digest.hexdigest()}

    def to_file(self) -> tuple[dict[str, Tensor], AgentHeader]:
        """Return tensors and the header that ``from_file`` needs."""
        return self.weights, AgentHeader(
            config_to_json(self.algorithm.config),
            space_to_json(self.observation_space),
            space_to_json(self.action_space),
        )

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], header: AgentHeader, where: str) -> AgentPolicy:
        """Create a policy from the tensors and header of ``to_file``.

        Raises:
            RunError: the header is damaged; or tensors are missing, have shapes or types that
                differ from the header, or are not finite.
        """
        try:
            spaces = map(space_from_json, (header.observation_space, header.action_space))
            config = config_from_json(header.algorithm, path="algorithm")
            algorithm = make_algorithm(config, *spaces)
        except SkillweaveError as error:
            raise RunError(f"{where}: {error}") from error
        weights = {
            name: checked_tensor(tensors, name, shape, torch.float32, where)
            for name, shape in algorithm.weight_shapes().items()
        }
        check_finite(weights, where)
        policy = cls(algorithm, weights)
        policy.name_outliers(where)
        return policy


class TrainedNetwork(RowPolicy):
    """The network of a trained agent, as it acts.

    Args:
        agent: whose network it is.
    """

    def __init__(self, agent: AgentPolicy) -> None:
        self.agent = agent

    def start(self, n: int) -> Memory:
        """Return the initial recurrent state, zeros (n, M); empty if the network has none."""
        size = self.agent.algorithm.memory_size
        return {"rnn": np.zeros((n, size), np.float32)} if size else {}

    @torch.inference_mode()
    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, ...) in the environment's units; greedy, or sampled."""
        agent, algorithm = self.agent, self.agent.algorithm
        noise = None
        if not turn.greedy:
            rng = turn.world.rng or np.random.default_rng()
            generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
            noise = algorithm.noise([generator], 1, len(obs))[0]
        mask = algorithm.widened(turn.mask)
        allowed = None if mask is None else torch.from_numpy(mask)[None]
        seen = to_tensor(np.ascontiguousarray(pack(agent.observation_space, obs)))[None]
        agent.look(seen)
        before = torch.from_numpy(memory["rnn"][rows])[None] if "rnn" in memory else None
        action, _, after = algorithm.act(agent.params, seen, allowed, noise, before)
        if after is not None:
            memory["rnn"][rows] = after[0].numpy()
        in_env: Array = algorithm.to_env(action[0].numpy())
        return in_env


@dataclass
class AgentHeader:
    """The header of a policy's file."""

    algorithm: dict[str, Any]
    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    kind: Literal["agent"] = "agent"
    run: str | None = None
    """The run in which the policy was trained."""
    stage: str | None = None
    starts: str | None = None
    """The learner of a new run that starts from the policy."""
    env: str | None = None
    """The environment, in a file of weights alone."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    code: dict[str, str] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    """Further entries, of agents of AgileRL's interface."""


def checked_tensor(
    tensors: Mapping[str, Tensor], name: str, shape: tuple[int, ...], dtype: torch.dtype, where: str
) -> Tensor:
    """Return a tensor of a trained agent's file by name.

    Raises:
        RunError: the tensor is missing, or has another shape or type.
    """
    tensor = tensors.get(name)
    if tensor is None or tuple(tensor.shape) != shape:
        shape_found = "nothing" if tensor is None else tuple(tensor.shape)
        raise RunError(f"{where}: tensor {name} should be {shape}, found {shape_found}")
    if tensor.dtype != dtype:
        raise RunError(f"{where}: tensor {name} should hold {dtype}, found {tensor.dtype}")
    return tensor


def check_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise a RunError where a tensor of a trained agent's file holds NaN or infinity."""
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise RunError(
                f"{where}: tensor {name} holds NaN or infinity: the training had diverged, or the "
                "file was altered"
            )


def state_from(
    tensors: Mapping[str, Tensor],
    like: S,
    where: str,
    groups: Sequence[ParameterGroup] = (),
) -> S:
    """Read a state from ``tensors`` by field, with the shapes and types of ``like``.

    Args:
        groups: of the algorithm, if networks may have grown.

    Raises:
        RunError: a tensor has another shape or type; it is named.
    """
    shapes = {name: tuple(value.shape) for name, value in vars(like).items()}
    for family in groups:  # after growth each parameter has an age of its own
        if family.count in tensors and tensors[family.count].ndim > 1:
            shapes[family.count] = shapes[family.weights[0]]
    values = {
        name: checked_tensor(tensors, name, shapes[name], value.dtype, where)
        for name, value in vars(like).items()
    }
    return type(like)(**values)


__all__ = [
    "AgentHeader",
    "AgentPolicy",
    "check_finite",
    "checked_tensor",
    "make_algorithm",
    "state_from",
]
