"""A policy in one environment, an observation at a time: for deployment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from skillweave.arguments import checked_names
from skillweave.collecting.skill_set import in_place
from skillweave.envs.infos import MASK, batched_infos, checked_mask, observes_mask
from skillweave.errors import DeclarationError
from skillweave.hierarchy.policy import SkillAlone
from skillweave.messages import short
from skillweave.policies.core import Memory, Turn, World
from skillweave.spaces import (
    allows_each,
    choice_counts,
    env_form,
    obs_dtype,
    obs_shape,
    put_observation,
)
from skillweave.spaces.packing import parts
from skillweave.types import Array, Policy, Step

ROW = np.zeros(1, np.int64)
"""The one environment."""


@checked_names
class Player:
    """A policy that acts in one environment and keeps its memory.

    ```python
    import gymnasium as gym
    import skillweave as sw

    env = gym.make("CartPole-v1")
    policy = sw.from_function(
        lambda obs: (obs[:, 2] > 0).astype(int),
        observation_space=env.observation_space,
        action_space=env.action_space,
    )
    player = sw.Player(policy)  # of a run: run.player()
    obs, info = env.reset(seed=0)
    player.reset()
    ended = False
    while not ended:
        obs, reward, terminated, truncated, info = env.step(player.act(obs))
        ended = terminated or truncated
    ```

    Args:
        policy: the policy that acts.
        deterministic: act greedily, else sample.
        seed: the seed of sampled actions.
        goal: of a skill with goals that acts alone (``run.player(skill="go_to", goal=...)``), until
            ``reset`` sets another; None: its ``goals()`` draw one in each episode.

    Raises:
        DeclarationError: a goal is given to a policy that takes none.
        SkillError: the goal is out of the skill's ``goal_space``.
    """

    def __init__(
        self, policy: Policy, *, deterministic: bool = True, seed: int = 0, goal: Any = None
    ) -> None:
        self.policy, self._deterministic = policy, deterministic
        self._space = policy.observation_space
        self._dtype, self._shape = obs_dtype(self._space), obs_shape(self._space)
        self._choices = choice_counts(policy.action_space)
        self._seed = seed
        self._world = World(np.random.default_rng(seed))
        self.reset(goal=goal)

    def reset(self, *, goal: Any = None) -> None:
        """Start a new episode with an empty memory.

        Args:
            goal: as of ``Player``; None: as before.

        Raises:
            DeclarationError: a goal is given to a policy that takes none.
            SkillError: the goal is out of the skill's ``goal_space``; the goal before stays.
        """
        if goal is not None:
            if not isinstance(self.policy, SkillAlone):
                raise DeclarationError(
                    f"the goal {short(goal)} is given to a policy that takes none: name a skill "
                    'with goals, run.player(skill="go_to", goal=...)'
                )
            self.policy = self.policy.with_goal(goal, "the player")
        self._acts = in_place(self.policy)
        self.memory: Memory = self._acts.start(1)
        self._before: tuple[Array, Array] | None = None
        self._elapsed = 0

    def act(
        self,
        obs: Any,
        *,
        reward: float = 0.0,
        info: Mapping[str, Any] | None = None,
        mask: Any = None,
    ) -> Any:
        """Return the action for one observation, as the environment takes it.

        Args:
            obs: what the environment's ``reset`` or ``step`` returned.
            reward: the reward of the step; needed only where a skill's ``termination`` reads it.
            info: the step's info; an ``action_mask`` in it is used where ``mask`` is left out.
            mask: (A,) the actions that the environment allows, ``env.action_masks()`` for example;
                of a Dict or Tuple also a dict or tuple of masks. None: the mask in ``info``, or the
                observation's part ``action_mask``; else all.

        Raises:
            DeclarationError: the observation or the mask does not fit the policy; the message
                names what does.
        """
        seen, given = self._seen(obs), dict(info or {})
        if self._choices and given.get(MASK) is not None:
            given[MASK] = self._allowed(given[MASK])[0]
        if self._before is not None:
            self._elapsed += 1
            self._acts.observe(self.memory, ROW, self._step(seen, reward, given))
        if mask is not None and not self._choices:
            raise DeclarationError(
                f"act(): mask is {short(mask)}, but actions of {short(self.policy.action_space)} "
                "are real numbers alone, none of which can be forbidden: leave it out"
            )
        if mask is None and self._choices:
            mask = given.get(MASK)
        if mask is None and observes_mask(self._space, self.policy.action_space):
            mask = seen[MASK].reshape(-1)
        allowed = None if mask is None else self._allowed(mask)
        if self._before is None and isinstance(self.policy, SkillAlone):
            self.policy.choose_goals(self.memory, ROW, seen, [self._world.rng])
        turn = Turn(self._world, allowed, greedy=self._deterministic)
        action = self._acts.act(self.memory, ROW, seen, turn)
        self._before = seen, action
        return env_form(self.policy.action_space, action[0])

    def _allowed(self, mask: Any) -> Array:
        """Return a mask as a batch of one."""
        try:
            allowed = checked_mask(mask, self.policy.action_space)
        except ValueError as error:
            raise DeclarationError(f"act(): {error}") from error
        if not allows_each(allowed, self._choices):
            raise DeclarationError("act(): its action_mask allows no action")
        return allowed[None]

    def _step(self, seen: Array, reward: float, info: Mapping[str, Any]) -> Step:
        """Return the step that led to an observation."""
        assert self._before is not None
        obs, action = self._before
        no = np.zeros(1, bool)
        return Step(
            obs,
            action,
            seen,
            np.array([reward], np.float32),
            terminated=no,
            truncated=no,
            timed_out=no,
            elapsed=np.array([self._elapsed]),
            info=batched_infos([dict(info)]),
        )

    def _misfit(self, obs: Any, error: Exception) -> str:
        """Return the reason why an observation does not fit, for messages."""
        if isinstance(error, KeyError):
            return f"it has no part {error}"
        if not isinstance(obs, np.ndarray):
            return str(error)
        if parts(self._space) is not None:
            return f"it is an array of shape {obs.shape}"
        several = obs.shape[1:] == self._shape
        return f"{error}{'; give one, without an axis of environments' if several else ''}"

    def _seen(self, obs: Any) -> Array:
        """Return one observation as a batch of one."""
        batch = np.empty((1, *self._shape), self._dtype)
        try:
            put_observation(self._space, batch, 0, obs)
        except (TypeError, ValueError, KeyError, IndexError) as error:
            raise DeclarationError(
                f"act() was given an observation that does not fit {self._space}: "
                + self._misfit(obs, error)
            ) from error
        return batch
