"""A trained agent as a policy, and as a file."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import (
    DQN,
    PPO,
    SAC,
    TD3,
    AlgorithmConfig,
    config_from_json,
    config_to_json,
)
from skillweave.algorithms.dqn import DQNAlgorithm
from skillweave.algorithms.ppo import PPOAlgorithm
from skillweave.algorithms.sac import SACAlgorithm
from skillweave.algorithms.td3 import TD3Algorithm
from skillweave.spaces import pack, space_from_json, space_to_json, to_tensor
from skillweave.types import Array, Memory, Memoryless, SkillweaveError

_ALGORITHMS: dict[type, type[Algorithm]] = {
    PPO: PPOAlgorithm,
    DQN: DQNAlgorithm,
    TD3: TD3Algorithm,
    SAC: SACAlgorithm,
}


def make_algorithm(config: AlgorithmConfig, observation_space: Any, action_space: Any) -> Algorithm:
    """The algorithm that these settings belong to, on one pair of spaces.

    Raises:
        SkillweaveError: it cannot act in these spaces; the message names those that can.
    """
    return _ALGORITHMS[type(config)](config, observation_space, action_space)


class AgentPolicy(Memoryless):
    """One trained agent; a copy of what acting needs, independent of further learning."""

    def __init__(self, algorithm: Algorithm, weights: dict[str, Tensor]) -> None:
        self.algorithm, self.weights = algorithm, weights
        self._actor = algorithm.actor_of(weights)
        self.observation_space = algorithm.observation_space
        self.action_space = algorithm.action_space

    @classmethod
    def of(cls, algorithm: Algorithm, state: Any, member: int = 0) -> AgentPolicy:
        """The policy of one member of a state."""
        return cls(algorithm, algorithm.weights(state, member))

    def start(self, n: int) -> Memory:
        """Zeros, (n, M), where the network has a memory."""
        size = self.algorithm.memory
        return {"rnn": np.zeros((n, size), np.float32)} if size else {}

    @torch.inference_mode()
    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Actions (n, ...) in the environment's units; greedy, or sampled with ``rng``."""
        noise = None
        if not deterministic:
            rng = rng or np.random.default_rng()
            generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
            noise = self.algorithm.noise([generator], 1, len(obs))[0]
        allowed = None if mask is None else torch.from_numpy(mask)[None]
        rows = to_tensor(np.ascontiguousarray(pack(self.observation_space, obs)))[None]
        before = torch.from_numpy(memory["rnn"])[None] if memory else None
        action, _, after = self.algorithm.act(self._actor, rows, allowed, noise, before)
        memory = {} if after is None else {"rnn": after[0].numpy()}
        return self.algorithm.to_env(action[0].numpy()), memory

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and the JSON that ``from_file`` needs."""
        return self.weights, {
            "kind": "agent",
            "algorithm": config_to_json(self.algorithm.config),
            "observation_space": space_to_json(self.observation_space),
            "action_space": space_to_json(self.action_space),
        }

    @classmethod
    def from_file(
        cls, tensors: dict[str, Tensor], header: dict[str, Any], where: str
    ) -> AgentPolicy:
        """The inverse of ``to_file``.

        Raises:
            SkillweaveError: tensors are missing or have other shapes than the header says.
        """
        missing = [k for k in ("algorithm", "observation_space", "action_space") if k not in header]
        if missing:
            raise SkillweaveError(f"{where} holds no agent: its header has no {', '.join(missing)}")
        spaces = (space_from_json(header[f"{k}_space"]) for k in ("observation", "action"))
        algorithm = make_algorithm(config_from_json(header["algorithm"]), *spaces)
        wanted = algorithm.weight_shapes()
        for name, shape in wanted.items():
            if name not in tensors or tuple(tensors[name].shape) != shape:
                found = tuple(tensors[name].shape) if name in tensors else "nothing"
                raise SkillweaveError(f"{where}: tensor {name} should be {shape}, found {found}")
        return cls(algorithm, {name: tensors[name] for name in wanted})
