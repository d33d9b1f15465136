"""Combinators around a policy: the goal beside the observation, reflexes, the last action."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from .core import Around, Array, Memory, Policy, Step, Turn, World

OBSERVATION, GOAL = "observation", "goal"
"""The parts of what a skill with a goal observes."""
OWN_GOAL, LAST_ACTION = "_goal", "_last_action"
"""Names under which ``Given`` and ``Remembers`` remember, beside those of their policy."""


class Joined(Around):
    """The policy observes the goal of its call beside the observation, as one record."""

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions for observations with their goals."""
        assert turn.goal is not None
        return self.policy.act(memory, rows, joined(obs, turn.goal), turn)


def joined(obs: Array, goal: Array, axes: int = 1) -> Array:
    """Return records of observations and goals.

    Args:
        obs: (…, *obs_shape).
        goal: (…, *goal_shape).
        axes: the number of the first axes, ``…``.
    """
    # Zeros, because the bytes between parts are written to files.
    joint = np.zeros(
        goal.shape[:axes], joint_dtype(obs.dtype, obs.shape[axes:], goal.dtype, goal.shape[axes:])
    )
    joint[OBSERVATION], joint[GOAL] = obs, goal
    return joint


@lru_cache(64)
def joint_dtype(
    obs: np.dtype[Any], shape: tuple[int, ...], goal: np.dtype[Any], goal_shape: tuple[int, ...]
) -> np.dtype[Any]:
    """Return the dtype of observations with goals, as ``obs_dtype`` of ``with_goal`` has it."""
    return np.dtype([(OBSERVATION, obs, shape), (GOAL, goal, goal_shape)], align=True)


class Corrects(Around):
    """A policy whose actions are added to those of another one, which is ready.

    Args:
        base: the policy that it corrects.
        apply: makes actions of those of ``base`` and of the policy, (k, …) each.
    """

    def __init__(
        self, policy: Policy, base: Policy, apply: Callable[[Array, Array], Array]
    ) -> None:
        super().__init__(policy)
        self.watches = policy.watches or base.watches
        self.base = base
        self._apply = apply

    def start(self, n: int) -> Memory:
        """Return the memories of both."""
        return {"own": self.policy.start(n), "base": self.base.start(n)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return corrected actions; what is corrected is greedy, and no mask counts for it."""
        own = self.policy.act(memory["own"], rows, obs, turn)
        alone = Turn(World(turn.world.rng), None, turn.goal)
        return self._apply(self.base.act(memory["base"], rows, obs, alone), own)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let both notice a step."""
        self.policy.observe(memory["own"], rows, step)
        self.base.observe(memory["base"], rows, step)


class Viewed(Around):
    """A policy that sees what a function makes of observations (…, *obs_shape)."""

    def __init__(self, policy: Policy, view: Callable[[Array], Array]) -> None:
        super().__init__(policy)
        self._view = view

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions for what it sees."""
        return self.policy.act(memory, rows, self._view(obs), turn)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice what it sees of a step."""
        if self.watches:
            seen = replace(step, obs=self._view(step.obs), next_obs=self._view(step.next_obs))
            self.policy.observe(memory, rows, seen)


class Reflexes(Around):
    """Rules that override the policy's action; the last one whose condition holds acts.

    Args:
        reflexes: ``apply(obs, actions, space)`` returns actions, and where it acted, (k,) bool.
        space: of the actions.
    """

    def __init__(self, policy: Policy, reflexes: Sequence[Any], space: Any) -> None:
        super().__init__(policy)
        self.reflexes = tuple(reflexes)
        self.space = space

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions, or those of a reflex."""
        action, holds = self.over(obs, self.policy.act(memory, rows, obs, turn))
        if turn.world.overridden is not None:
            turn.world.overridden[rows] |= holds
        return action

    def over(self, obs: Array, action: Array) -> tuple[Array, Array]:
        """Return actions (k, …) with those of reflexes in place, and (k,) bool: where one acted."""
        overridden = np.zeros(len(obs), bool)
        for reflex in self.reflexes:
            action, holds = reflex.apply(obs, action, self.space)
            overridden |= holds
        return action, overridden


class Given(Around):
    """A skill with goals that acts alone: who starts an episode sets its goal in the memory.

    Args:
        goals: ``start`` goals (see ``Goals``).
    """

    def __init__(self, policy: Policy, goals: Any) -> None:
        super().__init__(policy)
        self._goals = goals

    def start(self, n: int) -> Memory:
        """Return the policy's memory with goals."""
        return self.policy.start(n) | {OWN_GOAL: self._goals.start(n)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions for these goals."""
        own = Turn(turn.world, turn.mask, memory[OWN_GOAL][rows], turn.greedy)
        return self.policy.act(memory, rows, obs, own)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice a step with its goals."""
        if self.watches:
            self.policy.observe(memory, rows, replace(step, goal=memory[OWN_GOAL][rows]))


class Remembers(Around):
    """The outermost policy where the last action counts for a skill: it is remembered for all.

    Args:
        first: returns what stands for the last actions where n episodes start.
    """

    def __init__(self, policy: Policy, first: Callable[[int], Array]) -> None:
        super().__init__(policy)
        self.watches = True
        self._first = first

    def start(self, n: int) -> Memory:
        """Return the policy's memory with a last action."""
        return self.policy.start(n) | {LAST_ACTION: self._first(n)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions; who needs the last ones finds them in the world."""
        turn.world.last_action = memory[LAST_ACTION]
        return self.policy.act(memory, rows, obs, turn)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Remember the actions of a step."""
        memory[LAST_ACTION][rows] = step.action
        self.policy.observe(memory, rows, step)
