"""Skillweave: teach agents skills on any Gymnasium environment, weave them into one policy."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skillweave.algorithms.config import PPO
    from skillweave.api import Hierarchy, Run
    from skillweave.envs.make import EnvSpec
    from skillweave.hierarchy.options import OptionsEnv
    from skillweave.networks.config import MLP
    from skillweave.skills import Reflex, Skill
    from skillweave.training.evaluation import Evaluation, evaluate
    from skillweave.types import Array, SkillweaveError, Step

__version__ = "0.1.0"

_HOME = {
    "Array": "types",
    "EnvSpec": "envs.make",
    "Evaluation": "training.evaluation",
    "Hierarchy": "api",
    "MLP": "networks.config",
    "OptionsEnv": "hierarchy.options",
    "PPO": "algorithms.config",
    "Reflex": "skills",
    "Run": "api",
    "Skill": "skills",
    "SkillweaveError": "types",
    "Step": "types",
    "evaluate": "training.evaluation",
}

__all__ = [
    "MLP",
    "PPO",
    "Array",
    "EnvSpec",
    "Evaluation",
    "Hierarchy",
    "OptionsEnv",
    "Reflex",
    "Run",
    "Skill",
    "SkillweaveError",
    "Step",
    "evaluate",
]


def __getattr__(name: str) -> Any:
    # Names are imported when first used: torch takes two seconds, which `--help` must not pay.
    if name not in _HOME:
        raise AttributeError(f"module 'skillweave' has no attribute {name!r}")
    return getattr(importlib.import_module(f"skillweave.{_HOME[name]}"), name)
