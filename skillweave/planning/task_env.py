"""An environment whose reward and ends are those of a task.

Stands alone because it is an environment; all else here plans or judges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.envs.infos import batched_infos
from skillweave.planning.goal import GoalTask
from skillweave.planning.task import Task
from skillweave.spaces import obs_dtype, obs_shape
from skillweave.spaces.packing import put_observation
from skillweave.types import Array, Step

OWN_REWARD = "env_reward"
OWN_SUCCESS = "env_success"
SUCCESS = "success"
"""Keys of info."""


def own_step(step: Step) -> Step:
    """Return a step of a ``TaskEnv`` as the environment itself gave it; another is unchanged."""
    if OWN_REWARD not in step.info:
        return step
    info = {k: v for k, v in step.info.items() if k.removeprefix("_") not in (SUCCESS, OWN_REWARD)}
    for mark in ("", "_"):  # batches mark under "_key" where a key is there
        if mark + OWN_SUCCESS in info:
            info[mark + SUCCESS] = info.pop(mark + OWN_SUCCESS)
    return replace(step, reward=np.asarray(step.info[OWN_REWARD], np.float32), info=info)


@dataclass(frozen=True)
class Tasked:
    """A wrapper, for ``EnvSpec(wrappers=)``: an environment's episodes are scored by a task."""

    task: Task

    def __call__(self, env: gym.Env[Any, Any]) -> TaskEnv:
        """Return the environment with the task's reward."""
        return TaskEnv(env, self.task)


class TaskEnv(gym.Wrapper[Any, Any, Any, Any]):
    """An environment with the reward of a task, which ends the episode where it is over.

    ``info["success"]`` says in each step whether the task has succeeded, if it can. The reward and
    the success of the environment itself are ``info["env_reward"]`` and ``info["env_success"]``:
    skills and planners go by these, see ``own_step``.
    """

    def __init__(self, env: gym.Env[Any, Any], task: Task) -> None:
        super().__init__(env)
        self.machine = task.own() if isinstance(task, GoalTask) else task
        self._state, self._elapsed = self.machine.start(1), 0
        self._obs = self._batch_of_one(None)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the environment and the task."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._state, self._elapsed = self.machine.start(1), 0
        self._obs = self._batch_of_one(obs)
        return obs, info

    def step(self, action: Any) -> Any:
        """Take a step; the reward is the task's."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._elapsed += 1
        after = self._batch_of_one(obs)
        step = Step(
            obs=self._obs,
            action=np.asarray(action)[None],
            next_obs=after,
            reward=np.array([reward], np.float32),
            terminated=np.array([terminated], bool),
            truncated=np.array([truncated], bool),
            timed_out=np.zeros(1, bool),
            elapsed=np.array([self._elapsed]),
            info=batched_infos([info]),
        )
        self._state, paid, over = self.machine.step(self._state, step)
        self._obs = after
        info = {**info, OWN_REWARD: float(reward)}
        if SUCCESS in info:
            info[OWN_SUCCESS] = info.pop(SUCCESS)
        if self.machine.accepting.any():
            info[SUCCESS] = bool(self.machine.has_succeeded(self._state)[0])
        return obs, float(paid[0]), bool(terminated or over[0]), bool(truncated), info

    def _batch_of_one(self, obs: Any) -> Array:
        """Return an observation as skills see it, (1, *obs_shape)."""
        space = self.observation_space
        batch = np.zeros((1, *obs_shape(space)), obs_dtype(space))
        if obs is not None:
            put_observation(space, batch, 0, obs)
        return batch
