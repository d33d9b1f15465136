"""Flat agents, F0 to F3: one policy, trained by the library's own loop.

All are evaluated on the task's own reward while they train, whatever they learn from.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import Agent, Array, EnvSpec, Skill
from skillweave.api.run import Run
from skillweave.hierarchy import training
from skillweave.runs.directory import RunDirectory
from skillweave.runs.starts import begin_with, keep_starts, learnt_in
from skillweave.training.periodic import PeriodicEvaluation
from skillweave.training.scene import skill_scene
from skillweave.training.stage import Stage
from skillweave.training.stage_run import StageRun
from skillweave.training.trainer import OneAgent


@dataclass
class Flat(Agent):
    """An agent that is judged by its task, and learns from it, perhaps changed."""

    learns_in: EnvSpec | None = None
    """F2: the environment with a bonus in its reward."""
    learns: Skill | None = None
    """F1: whose reward it learns."""
    starts_from: Path | None = None
    """F3: the run in which it has learnt another task."""

    def stages(self, name: str = "agent") -> list[Stage]:
        """Its only stage."""
        spec, skill = self.learns_in or self.spec, self.learns
        return [
            Stage(name, "agent", self.algorithm, self.steps, lambda _: skill_scene(spec, skill))
        ]

    def run(self, path: Path, seed: int) -> Run:
        """Train it, or finish what was begun there."""
        if path.exists():
            run = RunDirectory.open(path)
        else:
            content = self.manifest(seed)
            content["stages"][0]["workers"] = 1  # runs go side by side, and counts are shared
            learnt = {} if self.starts_from is None else learnt_in(self.starts_from)
            if self.starts_from is not None:
                begin_with(content["stages"], learnt, self.starts_from)
            keep = partial(keep_starts, learnt=learnt)
            run = RunDirectory.create(path, content | {"recipe": None, "track": ()}, keep)
        try:
            run.begin()
            policy = training.train(self, run, (), partial(_FlatLearner, self))
        finally:
            run.close()
        return Run(self, path, policy)


class _FlatLearner(OneAgent):
    """Evaluates on the task itself."""

    def __init__(self, flat: Flat, stage: StageRun) -> None:
        super().__init__(stage)
        self._flat = flat

    def open(self) -> Any:
        """Make the environments and the agent."""
        fresh, manifest = super().open(), self.stage.run.manifest
        self.evaluation = PeriodicEvaluation(
            skill_scene(self._flat.spec), self.stage.seeds,
            manifest.get("eval_every"), manifest.get("eval_episodes", 0),
        )  # fmt: skip
        self._open.callback(self.evaluation.close)
        return fresh


class Bonus(gym.Wrapper[Any, Any, Any, Any]):
    """Adds ``size / √n`` to the reward for the n-th visit of a cell.

    Bellemare et al. 2016 and Tang et al. 2017 ("#Exploration"): counts of cells in place of states.

    Args:
        counts: shared by all environments of a run.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        cells: Callable[[Array], Array],
        size: float,
        counts: Counter[tuple[int, ...]],
    ) -> None:
        super().__init__(env)
        self._cells, self._size, self._counts = cells, size, counts

    def step(self, action: Any) -> Any:
        """With the bonus."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        cell = tuple(int(x) for x in self._cells(np.asarray(obs)[None])[0])
        self._counts[cell] += 1
        bonus = self._size / np.sqrt(self._counts[cell])
        return obs, float(reward) + bonus, terminated, truncated, info


def with_bonus(spec: EnvSpec, cells: Callable[[Array], Array], size: float) -> EnvSpec:
    """The environment with a bonus for what was seldom seen."""
    add = partial(Bonus, cells=cells, size=size, counts=Counter())
    # A pool would not have the wrapper, and counts are of one process.
    return replace(spec, wrappers=(*spec.wrappers, add), workers=1, pool=None)
