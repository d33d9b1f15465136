"""A stage in a run, and the interface of its learners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.config import AlgorithmConfig, config_from_json
from skillweave.calls.recorder import Recorder
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import StageEntry
from skillweave.training.learning_task import LearningTask
from skillweave.training.stage import Policies
from skillweave.training.stage_log import StageLog


@dataclass(frozen=True)
class StageRun:
    """A stage in a run. The run's settings count: a resumed run keeps its first settings."""

    entry: StageEntry
    """The stage's entry in the manifest."""
    run: RunDirectory
    seeds: Seeds
    """The stage's node of the seed tree."""
    learning_task: LearningTask
    policies: Policies
    """Policies by path: ready skills, and those that earlier stages trained."""
    recorder: Recorder | None = None
    """Records the calls of the skills; None: no calls are logged."""

    def stages_before(self, name: str) -> list[StageEntry]:
        """Return the entries of finished stages in which a learner has learnt."""
        stages = self.run.manifest.stages
        return [s for s in stages if name in s.learns and s.done]

    @property
    def config(self) -> AlgorithmConfig:
        """The algorithm's settings."""
        return config_from_json(self.entry.algorithm)


class StageLearner(Protocol):
    """The learner of a stage: one agent, several agents, or a population."""

    def open(self) -> None:
        """Make the environments."""
        ...

    def restore(self, tensors: dict[str, Tensor], log: StageLog) -> None:
        """Restore a checkpoint, or prepare to start where ``tensors`` is empty."""
        ...

    def train(self) -> dict[str, AgentPolicy]:
        """Learn until the stage is over; return the trained policies, by name."""
        ...

    def states(self) -> dict[str, Any]:
        """Return the states of learners that may continue in a later stage, by name."""
        ...

    def close(self) -> None:
        """Release the environments."""
        ...


MakeLearner = Callable[[StageRun], StageLearner]
"""A function that makes the learner of a stage, by its entry in the manifest."""
