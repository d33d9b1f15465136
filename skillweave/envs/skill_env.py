"""The environment that an agent trains in: a task, or a skill's view of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave.envs.engine import Engine
from skillweave.seeding import Seeds
from skillweave.skills import Reflex, Skill, apply_reflexes, asked
from skillweave.types import Array, SkillweaveError, Step, VecStep

_PATIENCE = 5_000  # steps of random acting in search of a state where the skill may start


class SkillEnv:
    """N environments seen through a skill: its reward, its ends; each end is a real reset.

    A skill's ``termination`` terminates the episode (nothing is worth anything after it), its
    ``max_steps`` truncates it (its value goes on, and is bootstrapped). Where the skill may not
    start in the first state, random actions are taken until it may; they are not learnt from.

    Args:
        engine: the environments.
        skill: None for the task itself: the environment's own reward and ends.
        reflexes: in force while the skill acts.
    """

    def __init__(
        self, engine: Engine, skill: Skill | None = None, reflexes: tuple[Reflex, ...] = ()
    ) -> None:
        self.engine, self.skill, self.reflexes = engine, skill, reflexes
        self.num_envs = engine.num_envs
        self.observation_space, self.action_space = engine.observation_space, engine.action_space
        self._elapsed = np.zeros(self.num_envs, np.int64)
        self._ones = np.ones(self.num_envs, np.int64)
        self._never = np.zeros(self.num_envs, bool)
        self._obs: Array = np.empty(0)
        self._rng = np.random.default_rng(0)

    def reset(self, seeds: Seeds) -> Array:
        """Start all anew from a node of the seed tree; observations (N, *obs_shape)."""
        self._rng = (seeds / "start").numpy()
        self._elapsed[:] = 0
        self._obs = self.engine.reset((seeds / "env").integer())
        self._obs = self._startable(self._obs, np.arange(self.num_envs))
        return self._obs

    def mask(self) -> Array | None:
        """All actions are allowed."""
        return None

    def step(self, action: Array) -> VecStep:
        """Act in all environments. ``info`` gains the task's reward and the skill's success."""
        obs = self._obs
        if self.reflexes:
            action = apply_reflexes(self.reflexes, obs, action, self.action_space)
        raw = self.engine.step(action)
        self._elapsed += 1
        reward, terminated, truncated, info = raw.reward, raw.terminated, raw.truncated, raw.info
        if self.skill is not None:
            reward, terminated, truncated, info = self._judge(self.skill, obs, action, raw)
        ended = terminated | truncated
        self._obs = raw.next_obs
        if ended.any():
            ids = np.flatnonzero(ended)
            first = self.engine.reset_some(ids)
            self._obs = raw.next_obs.copy()
            self._obs[ids] = self._startable(first, ids)
            info = {**info, "length": self._elapsed.copy()}
            self._elapsed[ids] = 0
        return VecStep(
            raw.next_obs, self._obs, reward, terminated, truncated, self._ones, None, info
        )

    def close(self) -> None:
        """Release the engine."""
        self.engine.close()

    def _judge(self, skill: Skill, obs: Array, action: Array, raw: Any) -> Any:
        """The skill's reward and ends for one step of all environments."""
        n, at = self.num_envs, self._elapsed
        timed_out = self._never
        if skill.max_steps is not None:
            timed_out = (self._elapsed >= skill.max_steps) & ~raw.terminated
        step = Step(
            obs, action, raw.next_obs, raw.reward, raw.terminated, raw.truncated,
            timed_out, self._elapsed, raw.info,
        )  # fmt: skip
        reward = asked(skill, "reward", step, n, at)
        terminated = raw.terminated
        if skill.defines("termination"):
            terminated = terminated | asked(skill, "termination", step, n, at)
        truncated = (raw.truncated | timed_out) & ~terminated
        info = {**raw.info, "task_reward": raw.reward}
        if skill.defines("success"):
            info["success"] = asked(skill, "success", step, n, at)
        return reward, terminated, truncated, info

    def _startable(self, obs: Array, ids: Array) -> Array:
        """First observations (n, ...) of environments ``ids`` in which the skill may start."""
        if self.skill is None or not self.skill.defines("initiation"):
            return obs
        who = f"skill {self.skill.name!r}"
        obs = obs.copy()
        for _ in range(_PATIENCE):
            holds = asked(self.skill, "initiation", obs, len(ids))
            waiting = np.flatnonzero(~holds)
            if not len(waiting):
                return obs
            space = self.action_space
            space.seed(int(self._rng.integers(2**31)))
            action = np.stack([np.asarray(space.sample()) for _ in waiting])
            raw = self.engine.step(action, ids[waiting])
            obs[waiting] = raw.next_obs
            ended = np.flatnonzero(raw.terminated | raw.truncated)
            if len(ended):
                obs[waiting[ended]] = self.engine.reset_some(ids[waiting[ended]])
        raise SkillweaveError(
            f"{who}: initiation() held nowhere in {_PATIENCE} steps of random acting, so there is "
            "nothing to train on; widen it, or give an environment that starts where it holds"
        )
