"""Imitation: a network learns the choices of another policy, before it learns by itself."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.registry import make_algorithm
from skillweave.errors import DeclarationError
from skillweave.ops.distributions import mask_logits
from skillweave.ops.optim import adam_
from skillweave.ops.threads import torch_threads
from skillweave.policies.core import Array
from skillweave.spaces import pack, to_tensor

GRADIENT_STEPS, BATCH = 2_000, 256
LARGE_STEPS, LARGE_BATCH = 1_000, 64
"""Gradient steps and rows of each where observations hold large images: these take an eighth of the
time, which convolutions need nearly all of, and lead to about the same choices."""
LARGE = 36 * 36
"""Pixels from which on an image is large."""
RATE = 1e-3
"""Adam's step size at the start; it falls linearly to 0."""


def imitate(
    config: Any,
    obs: Array,
    may: Array,
    chances: Array,
    space: gym.Space[Any],
    seeds: Seeds,
    with_goals: tuple[gym.Space[Any], Array] | None = None,
) -> AgentPolicy:
    """Train a selector's network to choose by given probabilities (cross-entropy); return it.

    Args:
        config: settings of PPO; the network has no memory.
        obs: (n, *obs_shape).
        may: (n, choices) bool, the allowed choices.
        chances: (n, choices), the probability of each choice.
        space: of ``obs``.
        seeds: of the network's first weights and of the order of rows.
        with_goals: where skills have goals, the space of choices, and choices (n,) whose goals are
            to be likely; None: they have none.

    Raises:
        DeclarationError: the network has a memory.
    """
    choices = gym.spaces.Discrete(may.shape[1]) if with_goals is None else with_goals[0]
    algorithm: Any = make_algorithm(config, space, choices)
    if algorithm.memory_size:
        raise DeclarationError(
            "a selector with a recurrent network cannot start from a plan: use a network without "
            "memory, which sees the task's state"
        )
    state = algorithm.init([seeds])
    rows = to_tensor(np.ascontiguousarray(pack(space, obs)))[None]
    mask = torch.from_numpy(may)[None]
    wanted = torch.from_numpy(np.float32(chances))[None]
    action = None
    if with_goals is not None:
        action = torch.from_numpy(algorithm.head.codec.from_env(with_goals[1]))[None]
    large = any(height * width >= LARGE for _, height, width in algorithm.obs.images)
    steps, batch = (LARGE_STEPS, LARGE_BATCH) if large else (GRADIENT_STEPS, BATCH)
    rng = (seeds / "rows").torch()
    with torch.enable_grad(), torch_threads(1):
        algorithm.update_obs_stats(state, rows)
        for step in range(steps):
            some = torch.randint(len(obs), (min(batch, len(obs)),), generator=rng)
            leaves = algorithm.layout.leaves(state.params)
            params = algorithm.learning_params(state)
            found = algorithm.actor_net(leaves, algorithm.inputs(params, rows[:, some]))
            logits = mask_logits(found[..., : may.shape[1]], mask[:, some])
            loss = -(wanted[:, some] * logits.log_softmax(-1)).sum(-1).mean(1)
            if action is not None:
                std = leaves.get("actor.log_std")
                loss = loss - algorithm.head.of_goals(found, std, action[:, some]).mean(1)
            gradient = algorithm.layout.gradient(loss, leaves)
            rate = torch.full_like(loss.detach(), RATE * (1.0 - step / steps))
            adam_(state.params, gradient, state.mu, state.nu, state.count, rate)
    return AgentPolicy.of(algorithm, state)
