"""Checks that declarations of agents and hierarchies share."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any

import gymnasium as gym

from skillweave._internal.messages import short
from skillweave.algorithms.config import AlgorithmConfig, OnPolicy
from skillweave.buffers.ram import check_memory
from skillweave.envs.checked import is_batched, refuse_batched
from skillweave.envs.make import EnvSpec
from skillweave.schema import Check
from skillweave.spaces import obs_dtype, obs_shape

EnvValue = Annotated[
    str | Callable[..., gym.Env[Any, Any]] | EnvSpec,
    Check(
        "a Gymnasium id, a function that makes an environment, or an EnvSpec (environments are "
        "made many times over)",
        lambda x: not isinstance(x, gym.Env),
    ),
]
"""The environment of an agent or a hierarchy."""


def check_env(env: object) -> None:
    """Raise a DeclarationError where ``env`` is batched, or has ``kwargs`` that are not data."""
    if is_batched(env):
        raise refuse_batched(short(env))
    if isinstance(env, EnvSpec):
        _ = env.json_kwargs  # raises for kwargs that a run cannot record


def check_rollout(config: AlgorithmConfig | None, space: gym.Space[Any]) -> None:
    """Raise an error where the rollouts of an on-policy algorithm take too much memory."""
    if isinstance(config, OnPolicy):
        each = 2 * obs_dtype(space).itemsize * math.prod(obs_shape(space)) + 32
        size = config.num_envs * config.n_steps
        what = f"a rollout of {size:,} transitions of {short(space)}"
        check_memory(size, each, what, "num_envs or n_steps")
