"""What a skill's training sees, one environment at a time in plain Python: easy to believe."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from reference_calls import one_step

from skillweave.skills import Reflex, Skill
from skillweave.types import Array


@dataclass
class Row:
    """What came of one step."""

    valid: bool
    obs: Array
    next_obs: Array
    reward: float
    terminated: bool
    truncated: bool
    starts: bool  # an episode of the skill begins here


@dataclass
class ScalarSkill:
    """One environment seen through a skill; None: as it is."""

    env: Any
    skill: Skill | None
    seeds: Iterator[int]
    reflexes: tuple[Reflex, ...] = ()
    episodes: list[list[float]] = field(default_factory=list)
    """Return, return of the task, length, success of each that has ended; NaN: no such number."""

    def __post_init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self.obs, _ = self.env.reset(seed=next(self.seeds))
        self.elapsed, self.sums = 0, np.zeros(3)
        self._look()

    def _look(self) -> None:
        self.searching = self.skill is not None and not self.skill.initiation(self.obs[None])[0]

    def overridden(self, action: int) -> int:
        """What is done where a learner wants ``action``."""
        for reflex in self.reflexes:
            if reflex.condition(self.obs[None])[0]:
                override = reflex.action
                action = int(override(self.obs[None])[0] if callable(override) else override)
        return action

    def row(self, action: int) -> Row:
        """Do ``action`` in the environment."""
        obs, searching, starts = self.obs, self.searching, self.elapsed == 0
        self.obs, pay, terminated, truncated, info = self.env.step(action)
        truncated = truncated and not terminated
        pay = reward = float(np.float32(pay))
        success = math.nan
        if searching:
            found = Row(False, obs, self.obs, math.nan, False, False, False)
            over = terminated or truncated
        else:
            self.elapsed += 1
            if (skill := self.skill) is not None:
                step = one_step(
                    obs, action, self.obs, pay, terminated, truncated, self.elapsed, skill, info
                )
                reward = float(np.asarray(skill.reward(step), np.float32)[0])
                timed_out = bool(step.timed_out[0])
                terminated = terminated or bool(skill.termination(step)[0])
                truncated = (truncated or timed_out) and not terminated
                if type(skill).success is not Skill.success:
                    success = float(skill.success(step)[0])
            self.sums += reward, pay, 1
            found = Row(True, obs, self.obs, reward, terminated, truncated, starts)
            over = terminated or truncated
            if over:
                total, task, length = self.sums
                task = math.nan if self.skill is None else task
                self.episodes.append([total, task, length, success])
        if over:
            self._begin()
        elif searching:
            self._look()
        return found
