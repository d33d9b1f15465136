"""A stage in a run, and what whoever learns in it must be able to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import AlgorithmConfig, config_from_json
from skillweave.algorithms.policy import AgentPolicy
from skillweave.runs.directory import RunDirectory
from skillweave.seeding import Seeds
from skillweave.training.keep_best import KeepBest
from skillweave.training.scene import Scene
from skillweave.training.stage import Policies, Target
from skillweave.training.stage_log import StageLog


@dataclass(frozen=True)
class StageRun:
    """A stage in a run. The run's settings count: a resumed run goes on as it began."""

    entry: dict[str, Any]
    """The manifest's."""
    run: RunDirectory
    seeds: Seeds
    """The stage's node of the seed tree."""
    scene: Scene
    policies: Policies
    """Everyone who can act already."""

    @property
    def name(self) -> str:
        """The stage's."""
        return str(self.entry["name"])

    @property
    def config(self) -> AlgorithmConfig:
        """The algorithm's settings."""
        return config_from_json(self.entry["algorithm"])

    @property
    def budget(self) -> int:
        """Environment steps."""
        return int(self.entry["budget"])

    @property
    def continues(self) -> bool:
        """Whether it had ended, and was then given more steps."""
        return bool(self.entry.get("continued"))

    @property
    def target(self) -> Target | None:
        """Where the stage may end early."""
        told = self.entry.get("target")
        return None if told is None else Target(**told)

    @property
    def best(self) -> KeepBest | None:
        """What keeps the best weights; None: the last ones count."""
        if self.run.manifest.get("keep") != "best":
            return None
        return KeepBest("return" if self.target is None else self.target.of)


class StageLearner(Protocol):
    """Who learns in a stage: one agent, or a population."""

    schema: Any
    """Of the headers of its checkpoints."""

    def open(self) -> Any | None:
        """Make the environments; the state to begin with, if checkpoints hold one."""
        ...

    def go_on(self, state: Any | None, extra: dict[str, Tensor], log: StageLog) -> None:
        """Stand where a checkpoint says, or at the start where ``extra`` is empty."""
        ...

    def train(self, log: StageLog) -> dict[str, AgentPolicy]:
        """Learn until the stage is over; by name, those who learnt, as they end."""
        ...

    def states(self) -> dict[str, Any]:
        """By name, all that those have learnt who may learn on in a later stage."""
        ...

    def close(self) -> None:
        """Release the environments."""
        ...


MakeLearner = Callable[[StageRun], StageLearner]
"""Who is to learn in a stage, by its entry in the manifest."""


def begin_as(algorithm: Algorithm, state: Any, policy: AgentPolicy, steps: int) -> None:
    """Give a fresh ``state`` the weights of a policy that learnt from so many steps, in place."""
    algorithm.set_weights(state, policy.weights)
    state.obs_count.fill_(max(1.0, steps))
