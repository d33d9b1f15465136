"""Flat agents, F0 to F3: one policy, trained by the library's own loop.

All are evaluated on the task's own reward while they train, whatever they learn from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from skillweave import Agent, Skill
from skillweave.api import Run
from skillweave.hierarchy import training
from skillweave.runs.directory import RunDirectory
from skillweave.runs.initial_policies import (
    copy_initial_policies,
    learners_of_run,
    record_initial_policies,
)
from skillweave.training.agents import Agents
from skillweave.training.learning_task import skill_task
from skillweave.training.periodic import PeriodicEvaluation
from skillweave.training.role import agent_role
from skillweave.training.stage import Stage
from skillweave.training.stage_run import StageRun


@dataclass
class Flat(Agent):
    """An agent that is judged by its task, and learns from it, perhaps changed."""

    learns: Skill | None = None
    """F1 and F2: whose reward it learns."""
    starts_from: Path | None = None
    """F3: the run in which it has learnt another task."""

    def stages(self) -> list[Stage]:
        """Return its only stage."""
        role = replace(agent_role(self.spec), skill=self.learns)
        return [Stage("agent", "agent", self.algorithm, self.steps, lambda _: skill_task(role))]

    def run(self, path: Path, seed: int) -> Run:
        """Train it, or finish what was begun there."""
        if path.exists():
            run = RunDirectory.open(path)
        else:
            content = self.manifest(seed)
            content.stages[0].workers = 1  # runs go side by side
            learnt = {} if self.starts_from is None else learners_of_run(self.starts_from)
            if self.starts_from is not None:
                record_initial_policies(content.stages, learnt, str(self.starts_from))
            keep = partial(copy_initial_policies, learnt=learnt)
            run = RunDirectory.create(path, content, keep)
        try:
            run.begin()
            policy = training.train(self, run, (), partial(_FlatLearner, self))
        finally:
            run.close()
        return Run(self, path, policy)


class _FlatLearner(Agents):
    """Evaluates on the task itself."""

    def __init__(self, flat: Flat, stage: StageRun) -> None:
        super().__init__(stage)
        self._flat = flat

    def open(self) -> None:
        """Make the environments and the agent."""
        super().open()
        manifest = self.stage.run.manifest
        self.evaluation = PeriodicEvaluation(
            skill_task(agent_role(self._flat.spec)),
            self.stage.seeds,
            manifest.eval_every,
            manifest.eval_episodes,
            self.stage.config.num_envs,
        )
        self._resources.callback(self.evaluation.close)
