"""The policy that leads to where a skill may start: calls of other skills, or random actions.

Stands alone because it acts, and a collector records.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.collecting.skill_set import SkillSet, acting_policy, within
from skillweave.envs.infos import allowed_rows, random_actions
from skillweave.policies.core import RUNNING, Turn, World, flat, part_of, restart
from skillweave.spaces import obs_dtype, obs_shape
from skillweave.types import Array, Memory, Step, prefixed


class StartPolicy:
    """Calls skills at random wherever they may start; acts at random where none may.

    The skills sample, as a greedy skill may go round in circles forever. Where skills are named,
    all act as a selector lets them act, because their ends are the states to learn in.

    Args:
        skills: that can act already; None: there are none.
        num_envs: N.
        action_space: of one environment.
        named: names among ``skills``, of which one may have to be called last.
    """

    def __init__(
        self,
        skills: SkillSet | None,
        num_envs: int,
        action_space: gym.Space[Any],
        named: Collection[str] = (),
    ) -> None:
        self.skills = skills
        if skills is not None and not named:
            self.skills = replace(skills, greedy=False)
        names = () if skills is None else (skill.name for skill in skills.skills)
        self._is_named = np.array([name in named for name in names], bool)
        self._space = action_space
        self.kept: dict[str, Array] = {}
        """Its state in each environment, (N, …) each; changed in place."""
        self.values: dict[str, Any] = {}
        """As of ``Collector``."""
        if self.skills is not None:
            # The last action is in the ``World``: others act, too.
            self._policy = acting_policy(self.skills, outermost=False)
            self._hierarchy = within(self._policy)
            self._calls: Memory = self._policy.start(num_envs)
            self.kept = flat(self._calls, "starters.")
            self.values = prefixed("starters", self._policy.values())

    def act(
        self,
        ids: Array,
        obs: Array,
        mask: Array | None,
        rng: np.random.Generator,
        last: Array | None = None,
        last_action: Array | None = None,
    ) -> Array:
        """Return actions (k, …) in environments ``ids`` (k,); obs and mask are of all N.

        Args:
            last: (N,) bool, the next call is to be one of a named skill, if one may start.
            last_action: as of ``World``.
        """
        if self.skills is None:
            return random_actions(self._space, len(ids), rng, allowed_rows(mask, ids))
        self._call(ids[~self._runs(ids)], obs, rng, last)
        runs = self._runs(ids)
        called, free = ids[runs], ids[~runs]
        action: Array = np.zeros((len(ids), *obs_shape(self._space)), obs_dtype(self._space))
        if len(called):
            turn = Turn(World(rng, last_action=last_action), allowed_rows(mask, called))
            action[runs] = self._policy.act(self._calls, called, obs[called], turn)
        if len(free):
            allowed = allowed_rows(mask, free)
            action[~runs] = random_actions(self._space, len(free), rng, allowed)
        return action

    def observe(self, ids: Array, step: Step) -> Array:
        """Notice a step of environments ``ids`` (k,); return those in which no call runs now.

        Args:
            step: of these environments.
        """
        if self.skills is None or not len(ids):
            return ids
        runs = self._runs(ids)
        called = ids[runs]
        if not len(called):
            return ids
        rows = np.flatnonzero(runs)
        part = part_of(step, step.elapsed[rows], rows)
        self._policy.observe(self._calls, called, part)
        return np.concatenate([ids[~runs], called[self._calls["end"][called] != RUNNING]])

    def named(self, ids: Array) -> Array:
        """Return whether the open call in environments ``ids`` (k,) is a named skill's, (k,)."""
        is_named: Array = self._runs(ids) & self._is_named[self._calls["skill"][ids]]
        return is_named

    def stop(self, ids: Array) -> None:
        """End the calls in environments ``ids`` (k,): the skill starts, or an episode."""
        if self.skills is not None:
            restart(self._policy, self._calls, ids)

    def _runs(self, ids: Array) -> Array:
        """(k,) bool, a call runs."""
        runs: Array = self._calls["end"][ids] == RUNNING
        return runs

    def _call(
        self, ids: Array, obs: Array, rng: np.random.Generator, last: Array | None = None
    ) -> None:
        """Start calls in environments ``ids`` (k,) where some skill may start."""
        assert self.skills is not None
        if not len(ids):
            return
        may = self.skills.hierarchy.may_start(obs[ids])
        if last is not None:
            is_named = np.repeat(self._is_named, may.shape[1] // len(self._is_named))
            restricted = last[ids] & (may & is_named).any(axis=1)
            may = np.where(restricted[:, None], may & is_named, may)
        chance = np.where(may, rng.random(may.shape), -1.0)
        some = may.any(axis=1)
        choice = chance[some].argmax(axis=1)
        here, skill = obs[ids[some]], self._hierarchy.skill_of(choice)
        found = dict[int, Array]()
        for i, goals in self._hierarchy.goals.items():
            mine = np.flatnonzero(skill == i)
            if len(mine):
                found[i] = goals.start(len(choice))
                found[i][mine] = goals.draw(here[mine], rng)
        self._hierarchy.begin(self._calls, ids[some], choice, found)
