"""Who acts until the skill that is trained may start: other skills, in calls; else chance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.collecting.calls import SkillSet, Why
from skillweave.collecting.restored import ranges_of
from skillweave.envs.engine import RawStep
from skillweave.envs.infos import allowed_rows, info_rows, random_actions
from skillweave.types import Array, Memory, Step, prefixed


class Starters:
    """Skills that can act already, called at random wherever they may start.

    They sample, as a greedy skill may go round in circles for ever. Where none of them may start,
    actions are drawn at random from those allowed.

    Args:
        skills: None where nobody can act yet.
        num_envs: N.
        action_space: of one environment.
    """

    def __init__(
        self, skills: SkillSet | None, num_envs: int, action_space: gym.Space[Any]
    ) -> None:
        self.skills = None if skills is None else replace(skills, greedy=False)
        self._space, self._num_envs = action_space, num_envs
        self._calls: Memory = {} if skills is None else skills.start(num_envs)
        self.kept: dict[str, Array] = prefixed("starters", self._calls)
        """What is kept of each environment, (N, …) each; changed in place."""
        self.ranges: dict[str, range] = {}
        """As of ``Collector``."""
        if skills is not None:
            self.ranges |= prefixed("starters", ranges_of(skills))
            self.kept["starters.called"] = np.zeros(num_envs, bool)  # one of them acts

    def act(self, ids: Array, obs: Array, mask: Array | None, rng: np.random.Generator) -> Array:
        """Actions (k, …) in environments ``ids`` (k,); obs and mask are of all N."""
        if self.skills is None:
            return random_actions(self._space, len(ids), rng, allowed_rows(mask, ids))
        called = self.kept["starters.called"]
        self._call(ids[~called[ids]], obs, rng)
        led = called[ids]
        own, free = ids[led], ids[~led]
        action: Array = np.empty((len(ids), *self._space.shape), self._space.dtype)  # type: ignore[misc]
        if len(own):
            action[led] = self.skills.act(self._calls, own, obs[own], rng, allowed_rows(mask, own))
        if len(free):
            allowed = allowed_rows(mask, free)
            action[~led] = random_actions(self._space, len(free), rng, allowed)
        return action

    def observe(self, ids: Array, obs: Array, action: Array, raw: RawStep) -> Array:
        """Notice where calls in environments ``ids`` (k,) are over; the others are of all N.

        Returns:
            Those where nobody is called now.
        """
        if self.skills is None:
            return ids
        called = self.kept["starters.called"][ids]
        own = ids[called]
        if not len(own):
            return ids
        seen = Step(
            obs[own], action[own], raw.next_obs[own], raw.reward[own], raw.terminated[own],
            raw.truncated[own], np.zeros(len(own), bool), self._calls["elapsed"][own],
            info_rows(raw.info, own, self._num_envs),
        )  # fmt: skip
        over = self.skills.observe(self._calls, own, seen) != Why.RUNNING
        self.kept["starters.called"][own[over]] = False
        return np.concatenate([ids[~called], own[over]])

    def stop(self, ids: Array) -> None:
        """The calls in environments ``ids`` (k,) are over: the skill starts, or an episode."""
        if self.skills is not None:
            self.kept["starters.called"][ids] = False
            self.skills.forget(self._calls, ids)

    def _call(self, ids: Array, obs: Array, rng: np.random.Generator) -> None:
        """Begin calls in environments ``ids`` (k,) where some skill may start."""
        assert self.skills is not None
        if not len(ids):
            return
        may = self.skills.startable(obs[ids])
        chance = np.where(may, rng.random(may.shape), -1.0)
        some = may.any(axis=1)
        self.skills.begin(self._calls, ids[some], chance[some].argmax(axis=1))
        self.kept["starters.called"][ids[some]] = True
