"""Skillweave: teach agents skills on any Gymnasium environment, weave them into one policy."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skillweave.algorithms.base import ActingParams, AgentState, Algorithm
    from skillweave.algorithms.config import DQN, PPO, SAC, TD3, OnPolicy, SelfImitationPPO
    from skillweave.algorithms.parameters import ParameterGroup
    from skillweave.algorithms.registry import register_algorithm
    from skillweave.algorithms.schedules import Linear
    from skillweave.api import Agent, Hierarchy, Run, train_agent
    from skillweave.api.loading import from_hub, load
    from skillweave.api.options import make_options_env
    from skillweave.api.player import Player
    from skillweave.api.policies import load_policy, save_policy
    from skillweave.collecting.cluster import Ray
    from skillweave.collecting.lengths import Lengths
    from skillweave.envs.make import EnvSpec
    from skillweave.envs.pool import PoolWrapper, envpool, one_of
    from skillweave.errors import (
        DeclarationError,
        EnvError,
        Interrupted,
        MissingExtra,
        PolicyError,
        RunError,
        SkillError,
        SkillweaveError,
        TrainingError,
    )
    from skillweave.evolution.config import Evolution, Mutations, Range, Tournament, Truncation
    from skillweave.evolution.selection import Heir, ParentSelection
    from skillweave.experience import Report, Rollout, Sample
    from skillweave.export.write import Export
    from skillweave.hierarchy.options import OptionsEnv
    from skillweave.hierarchy.policy import HierarchyPolicy
    from skillweave.hierarchy.settings import Apart, Guide, Selection
    from skillweave.networks.config import CNN, RNN, Network
    from skillweave.networks.encoders import Encoder, register_encoder
    from skillweave.networks.heads import ActionHead
    from skillweave.networks.net import Net
    from skillweave.networks.stacked import Layout
    from skillweave.ops.distributions import mask_logits
    from skillweave.ops.moments import masked_mean, normalize
    from skillweave.ops.optim import adam_, clip_grad_norm_
    from skillweave.ops.returns import gae
    from skillweave.reporting.curves_figure import plot_curves
    from skillweave.seeding import Seeds
    from skillweave.selectors import Automaton, LastCall, tree
    from skillweave.skills import (
        Reflex,
        Residual,
        Skill,
        from_function,
        from_onnx,
        from_sb3,
        from_torch,
    )
    from skillweave.skills.mapping import Acts, Goal, LastAction, Part
    from skillweave.training.callback import TrainEvent
    from skillweave.training.defaults import TrainDefaults
    from skillweave.training.evaluation import Evaluation, evaluate
    from skillweave.training.stage import Together
    from skillweave.types import Array, Policy, Step

__version__ = "0.1.0"

_HOME = {
    "ActingParams": "algorithms.base",
    "ActionHead": "networks.heads",
    "Acts": "skills.mapping",
    "Agent": "api",
    "AgentState": "algorithms.base",
    "Algorithm": "algorithms.base",
    "Apart": "hierarchy.settings",
    "Array": "types",
    "Automaton": "selectors",
    "CNN": "networks.config",
    "DQN": "algorithms.config",
    "DeclarationError": "errors",
    "Encoder": "networks.encoders",
    "EnvError": "errors",
    "EnvSpec": "envs.make",
    "Evaluation": "training.evaluation",
    "Evolution": "evolution.config",
    "Export": "export.write",
    "Goal": "skills.mapping",
    "Guide": "hierarchy.settings",
    "Heir": "evolution.selection",
    "Hierarchy": "api",
    "HierarchyPolicy": "hierarchy.policy",
    "Interrupted": "errors",
    "LastAction": "skills.mapping",
    "LastCall": "selectors",
    "Layout": "networks.stacked",
    "Lengths": "collecting.lengths",
    "Linear": "algorithms.schedules",
    "MissingExtra": "errors",
    "Mutations": "evolution.config",
    "Net": "networks.net",
    "Network": "networks.config",
    "OnPolicy": "algorithms.config",
    "OptionsEnv": "hierarchy.options",
    "PPO": "algorithms.config",
    "ParameterGroup": "algorithms.parameters",
    "ParentSelection": "evolution.selection",
    "Part": "skills.mapping",
    "Player": "api.player",
    "Policy": "types",
    "PolicyError": "errors",
    "PoolWrapper": "envs.pool",
    "RNN": "networks.config",
    "Range": "evolution.config",
    "Ray": "collecting.cluster",
    "Reflex": "skills",
    "Residual": "skills",
    "Report": "experience",
    "Rollout": "experience",
    "Run": "api",
    "RunError": "errors",
    "SAC": "algorithms.config",
    "Sample": "experience",
    "Seeds": "seeding",
    "Selection": "hierarchy.settings",
    "SelfImitationPPO": "algorithms.config",
    "Skill": "skills",
    "SkillError": "errors",
    "SkillweaveError": "errors",
    "Step": "types",
    "TD3": "algorithms.config",
    "Together": "training.stage",
    "Tournament": "evolution.config",
    "TrainDefaults": "training.defaults",
    "TrainEvent": "training.callback",
    "TrainingError": "errors",
    "Truncation": "evolution.config",
    "adam_": "ops.optim",
    "clip_grad_norm_": "ops.optim",
    "envpool": "envs.pool",
    "evaluate": "training.evaluation",
    "from_function": "skills",
    "from_hub": "api.loading",
    "from_onnx": "skills",
    "from_sb3": "skills",
    "from_torch": "skills",
    "gae": "ops.returns",
    "load": "api.loading",
    "load_policy": "api.policies",
    "make_options_env": "api.options",
    "mask_logits": "ops.distributions",
    "masked_mean": "ops.moments",
    "normalize": "ops.moments",
    "one_of": "envs.pool",
    "plot_curves": "reporting.curves_figure",
    "register_algorithm": "algorithms.registry",
    "register_encoder": "networks.encoders",
    "save_policy": "api.policies",
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
    "ActionHead",
    "Acts",
    "Agent",
    "AgentState",
    "Algorithm",
    "Apart",
    "Array",
    "Automaton",
    "DeclarationError",
    "Encoder",
    "EnvError",
    "EnvSpec",
    "Evaluation",
    "Evolution",
    "Export",
    "Goal",
    "Guide",
    "Heir",
    "Hierarchy",
    "HierarchyPolicy",
    "Interrupted",
    "LastAction",
    "LastCall",
    "Layout",
    "Lengths",
    "Linear",
    "MissingExtra",
    "Mutations",
    "Net",
    "Network",
    "OnPolicy",
    "OptionsEnv",
    "ParameterGroup",
    "ParentSelection",
    "Part",
    "Player",
    "Policy",
    "PolicyError",
    "PoolWrapper",
    "Range",
    "Ray",
    "Reflex",
    "Report",
    "Residual",
    "Rollout",
    "Run",
    "RunError",
    "Sample",
    "Seeds",
    "Selection",
    "SelfImitationPPO",
    "Skill",
    "SkillError",
    "SkillweaveError",
    "Step",
    "Together",
    "Tournament",
    "TrainDefaults",
    "TrainEvent",
    "TrainingError",
    "Truncation",
    "adam_",
    "clip_grad_norm_",
    "envpool",
    "evaluate",
    "from_function",
    "from_hub",
    "from_onnx",
    "from_sb3",
    "from_torch",
    "gae",
    "load",
    "load_policy",
    "make_options_env",
    "mask_logits",
    "masked_mean",
    "normalize",
    "one_of",
    "plot_curves",
    "register_algorithm",
    "register_encoder",
    "save_policy",
    "train_agent",
    "tree",
]


def __getattr__(name: str) -> Any:
    # Names are imported when first used: torch takes two seconds, which `--help` must not pay.
    if name not in _HOME:
        from difflib import get_close_matches

        near = get_close_matches(name, __all__, n=1)
        hint = f": is {near[0]!r} meant?" if near else ""
        raise AttributeError(f"module 'skillweave' has no attribute {name!r}{hint}")
    return getattr(importlib.import_module(f"skillweave.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
