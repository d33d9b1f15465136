"""Judging: the only place that calls a skill's reward, termination and success on transitions."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from functools import cached_property

import numpy as np

from skillweave._internal.seeding import Seeds, global_generators
from skillweave.algorithms.batches import INFO, Batch
from skillweave.envs.infos import random_actions, reported_success
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import DeclarationError
from skillweave.policies.core import own_step, part_of
from skillweave.policies.parts import GOAL, OBSERVATION
from skillweave.skills import Skill, asked, path_of
from skillweave.skills.goals import goals_of
from skillweave.skills.info_words import StoredInfo
from skillweave.skills.reads import info_keys_read
from skillweave.types import Array, Step


class Outcome:
    """The outcome of n steps for a skill; each of its methods is called when first needed.

    Args:
        skill: None for the task itself: the environment's own reward and ends.
        step: as the skill sees it; see ``seen_by``.
        ids: (n,) the environments, for messages; None: all n.
    """

    def __init__(self, skill: Skill | None, step: Step, ids: Array | None = None) -> None:
        self._skill, self._step, self._ids = skill, step, ids

    @cached_property
    def reward(self) -> Array:
        """(n,) float32."""
        return self._step.reward if self._skill is None else self._asked(self._skill, "reward")

    @cached_property
    def stops(self) -> Array:
        """(n,) bool, the skill's own termination() is true."""
        if self._skill is None or not self._skill.defines("termination"):
            return np.zeros(len(self._step.reward), bool)
        return self._asked(self._skill, "termination")

    @cached_property
    def terminated(self) -> Array:
        """(n,) bool, the value of what follows is 0."""
        terminated: Array = self._step.terminated | self.stops
        return terminated

    @cached_property
    def truncated(self) -> Array:
        """(n,) bool, cut by a time limit, the environment's or the skill's; never if terminated."""
        truncated: Array = (self._step.truncated | self._step.timed_out) & ~self.terminated
        return truncated

    @cached_property
    def success(self) -> Array | None:
        """(n,) bool; of the task float64, NaN where unknown; None: the skill defines none."""
        if self._skill is None:
            return reported_success(self._step.info, len(self._step.reward))
        return self._asked(self._skill, "success") if self._skill.defines("success") else None

    def _asked(self, skill: Skill, method: str) -> Array:
        return asked(skill, method, self._step, self._ids)


def judge(skill: Skill | None, step: Step, ids: Array | None = None) -> Outcome:
    """Judge n steps by a skill; the arguments are those of ``Outcome``."""
    return Outcome(skill, step, ids)


def judged_by(skill: Skill, spec: EnvSpec) -> JudgedBy:
    """Return a ``Relabel`` that judges by a skill, with the keys of ``info`` that it reads.

    Raises:
        DeclarationError: its reward changes, or it cannot be found out which keys it reads.
    """
    if skill.reward_changes:
        raise DeclarationError(
            f"skill {path_of(skill)!r}: its reward changes for the same step (reward_changes), so "
            "steps cannot be judged by it again: let its reward depend on the step alone"
        )
    if skill.sees is not None:
        raise DeclarationError(
            f"skill {path_of(skill)!r}: its rows hold only the part of observations that it sees "
            "(sees), so they cannot be judged again: leave out sees"
        )
    step = sample_step(spec)
    if (goals := goals_of(skill)) is not None:
        step = seen_by(skill, step, step.elapsed, goal=goals.start(1))
    return JudgedBy(skill, info_keys_read(skill, step))


@global_generators(Seeds(0) / "sample")
def sample_step(spec: EnvSpec) -> Step:
    """Return the first step of one environment, by a random action."""
    with closing(make_engine(spec, 1)) as engine:
        obs = engine.reset(0)
        rng = np.random.default_rng(0)
        action = random_actions(engine.action_space, 1, rng, engine.mask())
        return engine.step(action).seen(obs, action, np.ones(1, np.int64))


RAW = ("env_action", "env_reward", "env_terminated", "env_truncated", "call_elapsed")
"""The raw columns that rows are judged by again."""


class JudgedBy:
    """Judges stored rows by a skill: a ``Relabel`` of replay.

    Args:
        skill: whose reward and ends count; it must answer the same when asked twice.
        info: keys of ``info`` that its methods read, as ``info_keys_read`` finds them.
    """

    def __init__(self, skill: Skill, info: Sequence[str] = ()) -> None:
        self._skill = skill
        self._info = tuple(info)
        self.raw = (*RAW, *(INFO + key for key in info))

    def __call__(self, rows: Batch) -> Batch:
        """Return the rows, any lead axes, with the skill's reward and ends."""
        lead = rows["reward"].shape
        flat = {k: v.reshape(-1, *v.shape[len(lead) :]) for k, v in rows.items()}
        obs, next_obs, goal = flat["obs"], flat["next_obs"], None
        if self._skill.goal_space is not None:  # stored as its networks see them
            goal, obs, next_obs = obs[GOAL], obs[OBSERVATION], next_obs[OBSERVATION]
        step = Step(
            obs=obs,
            action=flat["env_action"],
            next_obs=next_obs,
            reward=flat["env_reward"],
            terminated=flat["env_terminated"],
            truncated=flat["env_truncated"],
            timed_out=np.zeros(len(flat["reward"]), bool),
            elapsed=flat["call_elapsed"],
            info=StoredInfo({key: flat[INFO + key] for key in self._info}),
        )
        outcome = judge(self._skill, seen_by(self._skill, step, step.elapsed, goal=goal))
        return rows.replace(
            reward=outcome.reward.reshape(lead),
            terminated=outcome.terminated.reshape(lead),
            truncated=outcome.truncated.reshape(lead),
        )


def seen_by(
    skill: Skill | None,
    step: Step,
    elapsed: Array,
    rows: Array | None = None,
    goal: Array | None = None,
) -> Step:
    """Return a step as a skill sees it, whose calls have their own time.

    Where the environment is scored by a task, a skill sees the environment's own reward.

    Args:
        skill: None: there is no limit, and the reward is the task's.
        elapsed: (m,) steps of its calls so far, this one included.
        rows: (m,) ascending, some rows of the step; None: all.
        goal: (m, *goal_shape) of its calls; None: it has no goals.
    """
    if skill is None:
        return part_of(step, elapsed, rows, None, goal)
    return part_of(own_step(step), elapsed, rows, skill.max_steps, goal)
