"""Skillweave: teach agents skills on any Gymnasium environment, weave them into one policy."""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

__version__ = "0.1.0"

if TYPE_CHECKING:
    from skillweave import (
        algorithms as algorithms,
        envs as envs,
        errors as errors,
        evolution as evolution,
        reporting as reporting,
        types as types,
        workers as workers,
    )
    from skillweave.algorithms.config import (
        CQL as CQL,
        DQN as DQN,
        IQL as IQL,
        PPO as PPO,
        SAC as SAC,
        TD3 as TD3,
    )
    from skillweave.api import (
        Agent as Agent,
        Hierarchy as Hierarchy,
        Run as Run,
        train_agent as train_agent,
    )
    from skillweave.api.loading import from_hub as from_hub, load as load
    from skillweave.api.player import Player as Player
    from skillweave.api.policies import load_policy as load_policy, save_policy as save_policy
    from skillweave.data.dataset import Dataset as Dataset
    from skillweave.data.recording import record as record
    from skillweave.envs.make import EnvSpec as EnvSpec
    from skillweave.errors import SkillweaveError as SkillweaveError
    from skillweave.hierarchy.settings import Apart as Apart, Guide as Guide, Selection as Selection
    from skillweave.networks.config import Network as Network
    from skillweave.policies.core import Step as Step
    from skillweave.robots.deploy_yaml import from_deploy as from_deploy
    from skillweave.robots.inputs import inputs as inputs
    from skillweave.robots.measuring import handovers as handovers
    from skillweave.robots.onnx_metadata import (
        from_metadata as from_metadata,
        reference_motion as reference_motion,
    )
    from skillweave.skills import (
        Reflex as Reflex,
        Residual as Residual,
        Skill as Skill,
        from_function as from_function,
        from_onnx as from_onnx,
        from_sb3 as from_sb3,
        from_torch as from_torch,
        tree as tree,
    )
    from skillweave.skills.automaton import Automaton as Automaton
    from skillweave.skills.lengths import Lengths as Lengths
    from skillweave.skills.mapping import (
        Acts as Acts,
        Elapsed as Elapsed,
        Goal as Goal,
        LastAction as LastAction,
        Part as Part,
        Table as Table,
    )
    from skillweave.training.defaults import TrainDefaults as TrainDefaults
    from skillweave.training.evaluation import evaluate as evaluate
    from skillweave.training.stage import Together as Together
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
