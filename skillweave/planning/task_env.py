"""An environment whose reward and ends are those of a task."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.envs.checked import last_observation
from skillweave.errors import EnvError
from skillweave.planning.goal import GoalTask
from skillweave.planning.mission import Task
from skillweave.policies.core import OWN_REWARD, OWN_SUCCESS, SUCCESS, Array, Step
from skillweave.policies.infos import batched_infos
from skillweave.spaces import obs_dtype, obs_shape
from skillweave.spaces.packing import parts, put_observation

OBSERVATION, TASK = "observation", "task"
"""Parts of observations that hold the task's state: what the environment gives, and that state."""


class OwnView:
    """An environment's own observations, of those of its ``TaskEnv`` that hold the task's state.

    Args:
        space: of the environment's own observations.
    """

    def __init__(self, space: gym.Space[Any]) -> None:
        self.space = space
        self._parts = obs_dtype(space).names if isinstance(space, gym.spaces.Dict) else None

    def obs(self, obs: Array) -> Array:
        """Return observations (n, …) without the task's state."""
        if self._parts is None:
            return np.ascontiguousarray(obs[OBSERVATION])
        own = np.empty(len(obs), obs_dtype(self.space))
        own[:] = obs[[*self._parts]]
        return own

    def joined(self, obs: Array, state: Array) -> Array:
        """Return the environment's observations (n, …) with the task's state (n, S)."""
        whole = _with_task(self.space, gym.spaces.Box(0.0, 1.0, state.shape[1:], np.float32))
        joined = np.empty(len(obs), obs_dtype(whole))
        joined[TASK] = state
        joined[OBSERVATION if self._parts is None else [*self._parts]] = obs
        return joined

    def step(self, step: Step) -> Step:
        """Return a step with the environment's own observations."""
        return replace(step, obs=self.obs(step.obs), next_obs=self.obs(step.next_obs))


@dataclass(frozen=True)
class Tasked:
    """A wrapper, for ``EnvSpec(wrappers=)``: an environment's episodes are scored by a task."""

    task: Task
    observe: bool = False
    """Observations hold the task's state."""

    def __call__(self, env: gym.Env[Any, Any]) -> TaskEnv:
        """Return the environment with the task's reward."""
        return TaskEnv(env, self.task, observe=self.observe)


class TaskEnv(gym.Wrapper[Any, Any, Any, Any]):
    """An environment with the reward of a task, which ends the episode where it is over.

    ``info["success"]`` says in each step whether the task has succeeded, if it can. The reward and
    the success of the environment itself are ``info["env_reward"]`` and ``info["env_success"]``:
    skills and planners go by these, see ``own_step``.

    Args:
        env: the environment.
        task: its task.
        observe: observations also hold the task's state, ``RewardMachine.observe``: a Dict has a
            part ``task`` more, other observations become a Dict of ``observation`` and ``task``.

    Raises:
        EnvError: the environment has a part or a key of ``info`` of such a name itself.
    """

    def __init__(self, env: gym.Env[Any, Any], task: Task, *, observe: bool = False) -> None:
        super().__init__(env)
        self.machine = task.at(None) if isinstance(task, GoalTask) else task
        self._own = env.observation_space
        self._observes = observe
        if observe:
            self.observation_space = _with_task(self._own, self.machine.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the environment and the task."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._state = self.machine.start(1)
        self._elapsed = 0
        self._obs = _batch_of_one(self._own, obs)
        return self._seen(obs), info

    def step(self, action: Any) -> Any:
        """Take a step; the reward is the task's."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._elapsed += 1
        if terminated or truncated:
            obs, info = last_observation(obs, info, self.env)
        after = _batch_of_one(self._own, obs)
        step = Step(
            obs=self._obs,
            action=self._packed(action),
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
        for key in (OWN_REWARD, OWN_SUCCESS):
            if key in info:
                raise EnvError(
                    f"info has the key {key!r}, under which a task keeps what the environment "
                    "itself gives; let the environment use another key"
                )
        info = {**info, OWN_REWARD: float(reward)}
        if SUCCESS in info:
            info[OWN_SUCCESS] = info.pop(SUCCESS)
        if self.machine.accepting.any():
            info[SUCCESS] = bool(self.machine.has_succeeded(self._state)[0])
        ended = bool(terminated or over[0])
        return self._seen(obs), float(paid[0]), ended, bool(truncated), info

    def _seen(self, obs: Any) -> Any:
        """Return an observation with the task's state, if it is to be observed."""
        if not self._observes:
            return obs
        own = obs if isinstance(self._own, gym.spaces.Dict) else {OBSERVATION: obs}
        return {**own, TASK: self.machine.observe(self._state)[0]}

    def _packed(self, action: Any) -> Array:
        """Return an action as skills see it, (1, *action_shape)."""
        space = self.action_space
        return np.asarray(action)[None] if parts(space) is None else _batch_of_one(space, action)


def _batch_of_one(space: gym.Space[Any], value: Any) -> Array:
    """Return a value of a space as skills see it, (1, …)."""
    batch = np.zeros((1, *obs_shape(space)), obs_dtype(space))
    put_observation(space, batch, 0, value)
    return batch


def _with_task(space: gym.Space[Any], task: gym.Space[Any]) -> gym.spaces.Dict:
    """Return the space of observations that hold a task's state."""
    if not isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({OBSERVATION: space, TASK: task})
    if TASK in space.spaces:
        raise EnvError(
            f"the environment's observations have a part {TASK!r}, and the task's state would have "
            "the same name; rename the environment's"
        )
    return gym.spaces.Dict({**space.spaces, TASK: task})
