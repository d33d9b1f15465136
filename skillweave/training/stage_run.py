"""A stage in a run, and the interface of its learners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import AlgorithmConfig, config_from_json
from skillweave.algorithms.policy import AgentPolicy
from skillweave.planning.recorder import Recorder
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import StageEntry, Target
from skillweave.training.keep_best import KeepBest
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

    @property
    def name(self) -> str:
        """Name of the stage."""
        return self.entry.name

    @property
    def learner(self) -> str:
        """Path of the learner, where there is one."""
        return self.entry.learns[0]

    def stages_before(self, name: str) -> list[StageEntry]:
        """Return the entries of finished stages in which a learner has learnt."""
        stages = self.run.manifest.stages
        return [s for s in stages if name in s.learns and s.done]

    def steps_before(self, name: str) -> int:
        """Return the environment steps of earlier stages in which a learner has learnt."""
        return sum(s.steps or 0 for s in self.stages_before(name))

    @property
    def config(self) -> AlgorithmConfig:
        """The algorithm's settings."""
        return config_from_json(self.entry.algorithm)

    @property
    def budget(self) -> int:
        """Budget in environment steps."""
        return self.entry.budget

    @property
    def continues(self) -> bool:
        """True for a finished stage that was given more steps."""
        return bool(self.entry.continued)

    @property
    def target(self) -> Target | None:
        """The target at which the stage ends early; None: without target."""
        return self.entry.target

    @property
    def best(self) -> KeepBest:
        """A new store of the best weights."""
        of = "return" if self.target is None else self.target.of
        return KeepBest(of, self.run.manifest.keep == "best")


class StageLearner(Protocol):
    """The learner of a stage: one agent, several agents, or a population."""

    def open(self) -> Any | None:
        """Make the environments; return the initial state, if checkpoints hold one."""
        ...

    def go_on(self, state: Any | None, extra: dict[str, Tensor], log: StageLog) -> None:
        """Restore a checkpoint, or prepare to start where ``extra`` is empty."""
        ...

    def train(self, log: StageLog) -> dict[str, AgentPolicy]:
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


def begin_as(algorithm: Algorithm, state: Any, policy: AgentPolicy, steps: int) -> None:
    """Give a fresh ``state`` the weights of a policy that learnt from ``steps`` steps, in place."""
    algorithm.set_weights(state, policy.weights)
    state.obs_count.fill_(max(1.0, steps))
