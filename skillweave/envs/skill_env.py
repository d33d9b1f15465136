"""The environment that an agent trains in: a task, or a skill's view of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.envs.engine import Engine, checksums
from skillweave.envs.infos import allowed_rows, random_actions
from skillweave.seeding import Seeds
from skillweave.skills import Reflex, Skill, apply_reflexes, asked
from skillweave.types import Array, SkillweaveError, Step, VecStep, prefixed, unprefixed

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
        self.obs: Array = np.empty(0)
        self._elapsed = np.zeros(self.num_envs, np.int64)
        self._all = np.arange(self.num_envs)
        self._ones = np.ones(self.num_envs, np.int64)
        self._never = np.zeros(self.num_envs, bool)
        self._seed = 0  # of the search for states where the skill may start
        self._rng = np.random.default_rng(0)

    @property
    def steps_made(self) -> int:
        """Steps that all environments have made, those in search of a start included."""
        return self.engine.steps_made

    def reset(self, seeds: Seeds) -> Array:
        """Start all anew from a node of the seed tree; observations (N, *obs_shape)."""
        self._search_from((seeds / "start").integer())
        self._elapsed[:] = 0
        self.obs = self._startable(self.engine.reset((seeds / "env").integer()), self._all)
        return self.obs

    def renew(self, seeds: Seeds) -> Array:
        """Take new seeds; environments whose episodes are too long to be kept begin anew."""
        self.engine.renew((seeds / "env").integer())
        begun = self._begin(np.flatnonzero(self._elapsed > LONGEST_EPISODE))
        self._search_from((seeds / "start").integer())
        return begun

    def state(self) -> dict[str, Array]:
        """All that ``restore`` needs, right after ``renew``."""
        own = {"elapsed": self._elapsed.copy(), "obs": checksums(self.obs)}
        own["seed"] = np.array([self._seed])
        return own | prefixed("engine", self.engine.state())

    def restore(self, state: dict[str, Array]) -> Array:
        """Play the open episodes again; the environments that did not repeat themselves."""
        self._search_from(int(state["seed"][0]))
        self._elapsed = state["elapsed"].copy()
        self.obs, early = self.engine.restore(unprefixed("engine", state))
        other = np.flatnonzero(checksums(self.obs) != state["obs"])
        return self._begin(np.union1d(early, other))

    def set_gamma(self, gamma: Array) -> None:
        """Nothing to do: every action lasts one step."""

    def mask(self) -> Array | None:
        """(N, A) bool, the actions that the environments allow now; None: all always are."""
        return self.engine.mask()

    def step(self, action: Array) -> VecStep:
        """Act in all environments. ``info`` gains the task's reward and the skill's success."""
        obs = self.obs
        if self.reflexes:
            action = apply_reflexes(self.reflexes, obs, action, self.action_space)
        raw = self.engine.step(action)
        self._elapsed += 1
        reward, terminated, truncated, info = raw.reward, raw.terminated, raw.truncated, raw.info
        if self.skill is not None:
            reward, terminated, truncated, info = self._judge(self.skill, obs, action, raw)
        ended = terminated | truncated
        self.obs, next_mask = raw.next_obs, self.engine.mask()
        if ended.any():
            info = {**info, "length": self._elapsed.copy()}
            self._begin(np.flatnonzero(ended))
        return VecStep(
            raw.next_obs, self.obs, reward, terminated, truncated, self._ones,
            self.engine.mask(), info, next_mask,
        )  # fmt: skip

    def close(self) -> None:
        """Release the engine."""
        self.engine.close()

    def _search_from(self, seed: int) -> None:
        self._seed, self._rng = seed, np.random.default_rng(seed)

    def _begin(self, ids: Array) -> Array:
        """Start environments ``ids`` (n,) anew; the same ids."""
        if len(ids):
            first = self._startable(self.engine.reset_some(ids), ids)
            self.obs = self.obs.copy()
            self.obs[ids] = first
            self._elapsed[ids] = 0
        return ids

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
            allowed = allowed_rows(self.engine.mask(), ids[waiting])
            action = random_actions(self.action_space, len(waiting), self._rng, allowed)
            raw = self.engine.step(action, ids[waiting])
            obs[waiting] = raw.next_obs
            ended = np.flatnonzero(raw.terminated | raw.truncated)
            if len(ended):
                obs[waiting[ended]] = self.engine.reset_some(ids[waiting[ended]])
        raise SkillweaveError(
            f"{who}: initiation() held nowhere in {_PATIENCE} steps of random acting, so there is "
            "nothing to train on; widen it, or give an environment that starts where it holds"
        )
