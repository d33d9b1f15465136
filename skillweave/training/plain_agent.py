"""A plain agent, the base case: one environment, one algorithm, one stage."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym

from skillweave.algorithms.config import AlgorithmConfig, OnPolicy, check_spaces
from skillweave.algorithms.policy import AgentPolicy
from skillweave.buffers.ram import check_memory
from skillweave.envs.make import EnvSpec
from skillweave.messages import short
from skillweave.runs.directory import RunDirectory
from skillweave.spaces import action_codec, obs_codec, obs_dtype, obs_shape
from skillweave.training.scene import skill_scene
from skillweave.training.stage import Stage, target_of
from skillweave.types import SkillweaveError

AGENT = "agent"
"""What a plain agent's stage is named."""


@dataclass
class PlainAgent:
    """An environment and who learns its own reward, with a budget in environment steps.

    Raises:
        SkillweaveError: a setting is wrong; the message names it.
    """

    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec`` for more."""
    algorithm: AlgorithmConfig
    """Its settings."""
    steps: int
    """Training budget in environment steps."""
    target_return: float | None = None
    """Training ends early at this mean return of the periodic evaluation; None: it does not."""
    target_success: float | None = None
    """Training ends early at this share of successful episodes (``info["success"]``)."""
    cut_every: int = 100_000
    """Environment steps between checkpoints."""
    eval_every: int | None = None
    """Environment steps between evaluations while it trains; None: none."""
    eval_episodes: int = 20
    """Episodes of each of these evaluations."""
    recorded = False
    """It is of a run that was loaded without its code, and knows less than was declared."""

    def __post_init__(self) -> None:
        check_env(self.env)
        check_algorithm(self.algorithm, "algorithm")
        check_fields(self)
        target_of(self.target_return, self.target_success, AGENT)

    @property
    def spec(self) -> EnvSpec:
        """The environment, fully specified."""
        return self.env if isinstance(self.env, EnvSpec) else EnvSpec(self.env)

    def check_spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        """Make the environment once; its observation space and action space.

        Raises:
            SkillweaveError: the algorithm does not fit it.
        """
        env = self.spec.make()
        try:
            obs_codec(env.observation_space)
            action_codec(env.action_space)
            check_spaces(self.algorithm, env.action_space, f"{AGENT}: ")
            check_rollout(self.algorithm, env.observation_space)
            return env.observation_space, env.action_space
        finally:
            env.close()

    def stages(self, name: str = AGENT) -> list[Stage]:
        """Its only stage; in runs of older versions it has another ``name``."""
        target = target_of(self.target_return, self.target_success, AGENT)
        spec = self.spec
        how = self.algorithm, self.steps, lambda _: skill_scene(spec), target
        return [Stage(name, "agent", *how)]

    def manifest(self, seed: int) -> dict[str, Any]:
        """What a new run's ``run.json`` says, for this ``seed``."""
        return {
            "kind": "agent",
            "env": self.spec.name,
            "env_kwargs": self.spec.kwargs,
            "seed": seed,
            "cut_every": self.cut_every,
            "eval_every": self.eval_every,
            "eval_episodes": self.eval_episodes,
            "needs_recipe": not self.spec.is_data,
            "resume_needs_recipe": not (self.spec.is_data and self.spec.engine == "auto"),
            "stages": [stage.entry() for stage in self.stages()],
        }


def load_agent_of(run: RunDirectory) -> AgentPolicy:
    """The policy of a finished run of a plain agent."""
    return run.load_policy(run.manifest["stages"][0]["name"])


# Checks that declarations share


def check_env(env: object) -> None:
    """Raise a SkillweaveError where ``env`` cannot be made many times over."""
    made = isinstance(env, gym.Env)
    if made or not (isinstance(env, str | EnvSpec) or callable(env)):
        raise SkillweaveError(
            f"env is {short(env)}; it must be a Gymnasium id, a function that makes an "
            "environment, or an EnvSpec (environments are made many times over)"
        )


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
