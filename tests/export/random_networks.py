"""Networks with random weights, and how their exports are compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.api.player import Player
from skillweave.export.runner import Runner
from skillweave.skills.foreign_policy import made_up
from skillweave.spaces import unpack

NESTED = gym.spaces.Dict(
    image=gym.spaces.Box(0, 255, (5, 5, 3), np.uint8),
    inner=gym.spaces.Tuple(
        (gym.spaces.Discrete(3, start=1), gym.spaces.Box(-1, 1, (2,), np.float64))
    ),
)


def agent(config: AlgorithmConfig, *spaces: gym.Space[Any], seed: int = 0) -> AgentPolicy:
    """An untrained agent whose weights and moments are far from their first values."""
    algorithm = make_algorithm(config, *spaces)
    policy = AgentPolicy.of(algorithm, algorithm.init([Seeds(seed)]))
    generator = torch.Generator().manual_seed(seed)
    weights = {}
    for name, value in policy.weights.items():
        noise = torch.randn(value.shape, generator=generator)
        weights[name] = value + (0.2 if "bias" in name or "obs" in name else 1.5) * noise
    if "obs_var" in weights:
        weights["obs_var"] = weights["obs_var"].abs() + 0.1
    return AgentPolicy(algorithm, weights)


def one_by_one(space: gym.Space[Any], n: int) -> list[Any]:
    """Observations as an environment gives them."""
    batch = made_up(space, n)
    return [unpack(space, batch[i]) for i in range(n)]


def same(a: Any, b: Any, rtol: float = 1e-4) -> bool:
    """Actions that are the same, numbers up to rounding."""
    a, b = np.asarray(a), np.asarray(b)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return np.allclose(a, b, rtol=rtol, atol=1e-5) if a.dtype.kind == "f" else bool((a == b).all())


def compare(
    policy: Any,
    folder: Path,
    seen: Any,
    parts: Any = (),
    code: Any = None,
    rtol: float = 1e-4,
) -> list[Any]:
    """Let a player and the runner act the same, in three episodes; return the actions.

    ``parts``: numbers of choices, of which masks allow some, now and then.
    """
    player, runner, rng, told = Player(policy), Runner(folder, code), np.random.default_rng(0), []
    for i, obs in enumerate(seen):
        if i in (7, 20):
            player.reset(), runner.reset()
        mask = None
        if parts and i % 2:
            mask = rng.random(sum(parts)) < 0.5
            mask[np.cumsum([1, *parts[:-1]])] = True  # one of each part
        told.append(player.act(obs, mask=mask))
        assert same(runner.act(obs, mask=mask), told[-1], rtol)
    assert len({str(np.round(x, 3)) for x in told}) > 1  # a constant would agree with anything
    return told
