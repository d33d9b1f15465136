"""Skillweave: teach agents skills on any Gymnasium environment, weave them into one policy."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skillweave.algorithms.base import ActingParams, Algorithm
    from skillweave.algorithms.config import DQN, PPO, SAC, TD3
    from skillweave.algorithms.registry import register_algorithm
    from skillweave.api import Agent, Hierarchy, Run, train_agent
    from skillweave.collecting.lengths import Lengths
    from skillweave.envs.make import EnvSpec
    from skillweave.envs.pool import PoolWrapper, envpool
    from skillweave.evolution.config import Evolution, Mutations, Range, Tournament, Truncation
    from skillweave.evolution.selection import Heir, Selection
    from skillweave.experience import Report, Rollout, Sample
    from skillweave.hierarchy.options import OptionsEnv
    from skillweave.networks.config import CNN, RNN, Network
    from skillweave.networks.encoders import Encoder, register_encoder
    from skillweave.selectors import Automaton, LastCall, tree
    from skillweave.skills import Reflex, Skill, from_function, from_onnx, from_sb3, from_torch
    from skillweave.training.evaluation import Evaluation, evaluate
    from skillweave.training.stage import Together
    from skillweave.types import Array, SkillweaveError, Step

__version__ = "0.1.0"

_HOME = {
    "ActingParams": "algorithms.base",
    "Algorithm": "algorithms.base",
    "Agent": "api",
    "Array": "types",
    "Automaton": "selectors",
    "CNN": "networks.config",
    "DQN": "algorithms.config",
    "Encoder": "networks.encoders",
    "EnvSpec": "envs.make",
    "Evaluation": "training.evaluation",
    "Evolution": "evolution.config",
    "Heir": "evolution.selection",
    "Hierarchy": "api",
    "Lengths": "collecting.lengths",
    "Mutations": "evolution.config",
    "LastCall": "selectors",
    "Network": "networks.config",
    "OptionsEnv": "hierarchy.options",
    "PPO": "algorithms.config",
    "PoolWrapper": "envs.pool",
    "RNN": "networks.config",
    "Range": "evolution.config",
    "Reflex": "skills",
    "Report": "experience",
    "Rollout": "experience",
    "Run": "api",
    "SAC": "algorithms.config",
    "Sample": "experience",
    "Selection": "evolution.selection",
    "Skill": "skills",
    "SkillweaveError": "types",
    "Step": "types",
    "TD3": "algorithms.config",
    "Together": "training.stage",
    "Tournament": "evolution.config",
    "Truncation": "evolution.config",
    "envpool": "envs.pool",
    "evaluate": "training.evaluation",
    "from_function": "skills",
    "from_onnx": "skills",
    "from_sb3": "skills",
    "from_torch": "skills",
    "register_algorithm": "algorithms.registry",
    "register_encoder": "networks.encoders",
    "train_agent": "api",
    "tree": "selectors",
}

__all__ = [
    "CNN",
    "DQN",
    "PPO",
    "RNN",
    "SAC",
    "TD3",
    "ActingParams",
    "Agent",
    "Algorithm",
    "Array",
    "Automaton",
    "Encoder",
    "EnvSpec",
    "Evaluation",
    "Evolution",
    "Heir",
    "Hierarchy",
    "LastCall",
    "Lengths",
    "Mutations",
    "Network",
    "OptionsEnv",
    "PoolWrapper",
    "Range",
    "Reflex",
    "Report",
    "Rollout",
    "Run",
    "Sample",
    "Selection",
    "Skill",
    "SkillweaveError",
    "Step",
    "Together",
    "Tournament",
    "Truncation",
    "envpool",
    "evaluate",
    "from_function",
    "from_onnx",
    "from_sb3",
    "from_torch",
    "register_algorithm",
    "register_encoder",
    "train_agent",
    "tree",
]


def __getattr__(name: str) -> Any:
    # Names are imported when first used: torch takes two seconds, which `--help` must not pay.
    if name not in _HOME:
        raise AttributeError(f"module 'skillweave' has no attribute {name!r}")
    return getattr(importlib.import_module(f"skillweave.{_HOME[name]}"), name)
