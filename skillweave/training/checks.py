"""Checks that declarations of agents and hierarchies share."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import gymnasium as gym

from skillweave.algorithms.config import AlgorithmConfig, OnPolicy
from skillweave.buffers.ram import check_memory
from skillweave.envs.checks import is_batched, refuse_batched
from skillweave.envs.make import EnvSpec
from skillweave.errors import SkillweaveError
from skillweave.messages import short
from skillweave.spaces import obs_dtype, obs_shape


def check_env(env: object) -> None:
    """Raise a SkillweaveError where ``env`` cannot be made many times over."""
    if is_batched(env):
        raise refuse_batched(short(env))
    made = isinstance(env, gym.Env)
    if made or not (isinstance(env, str | EnvSpec) or callable(env)):
        raise SkillweaveError(
            f"env is {short(env)}; it must be a Gymnasium id, a function that makes an "
            "environment, or an EnvSpec (environments are made many times over)"
        )
    if isinstance(env, EnvSpec):
        _ = env.json_kwargs  # says which of them a run cannot record


def check_algorithm(value: object, where: str, *, optional: bool = False, also: str = "") -> None:
    """Raise a SkillweaveError where ``value`` is no algorithm's settings; ``also`` may be given."""
    if (value is None and optional) or isinstance(value, AlgorithmConfig):
        return
    hint = f" (write {value.__name__}(), not {value.__name__})" if isinstance(value, type) else ""
    kinds = "no algorithm's settings" + (f", and no {also}" if also else "")
    raise SkillweaveError(f"{where} is {short(value)}, which is {kinds}{hint}")


def check_fields(declared: Any) -> None:
    """Raise a SkillweaveError where a field that is a whole number or a flag holds another."""
    for f in fields(declared):
        value, none = getattr(declared, f.name), f.type == "int | None"
        whole = f.type in ("int", "int | None") and not (value is None and none)
        if whole and (type(value) is not int or value < 1):
            what = "at least 1, or None" if none else "a whole number, at least 1"
            raise SkillweaveError(f"{f.name} is {short(value)}; it must be {what}")
        flag = f.type == "bool" or (f.type == "bool | None" and value is not None)
        if flag and not isinstance(value, bool):
            what = "True or False" if f.type == "bool" else "True, False or None"
            raise SkillweaveError(f"{f.name} is {short(value)}; it must be {what}")


def check_rollout(config: AlgorithmConfig | None, space: gym.Space[Any]) -> None:
    """Raise a SkillweaveError where the rollouts of an on-policy algorithm take too much memory."""
    if isinstance(config, OnPolicy):
        each = 2 * obs_dtype(space).itemsize * math.prod(obs_shape(space)) + 32
        size = config.num_envs * config.n_steps
        what = f"a rollout of {size:,} transitions of {short(space)}"
        check_memory(size, each, what, "num_envs or n_steps")
