"""Views of a trace: what each learner did, judged by its own skill after the steps were made.

Everything here is a function of the trace's columns. A skill's reward is called once for all rows
of a request in which the skill acted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from skillweave._internal.messages import short
from skillweave.algorithms.batches import INFO, OF_STEP, Batch, Trace
from skillweave.errors import EnvError, SkillweaveError
from skillweave.experience.judge import judge, seen_by
from skillweave.policies.core import OWN, RUNNING
from skillweave.skills import Skill
from skillweave.skills.goals import Goals, check_reads_goal, is_unchecked
from skillweave.skills.outputs import missing_key
from skillweave.skills.own_part import OwnPart
from skillweave.types import Array, Step

AT_ONCE = 1 << 26
"""Bytes of observations that a skill judges at once."""


def steps_of(
    trace: Trace,
    skill: Skill | None,
    acts: Array,
    elapsed: Array,
    end: Array,
    goal: Array | None = None,
) -> Batch:
    """Return the rows in which a skill acted, judged by its own reward and ends.

    Args:
        skill: None: the task itself.
        acts: (T, N) bool, the skill acts.
        elapsed: (T, N) int64, steps of its call so far.
        end: (T, N) int8, ``CallEnd`` of its call after the step.
        goal: (T, N, *goal_shape) of its calls; None: it has no goals.

    Returns:
        ``reward``, ``terminated`` and ``truncated``, 0 in other rows; ``valid`` is ``acts``.
    """
    if goal is not None and skill is not None and acts.any() and is_unchecked(skill):
        t = int(acts.any(axis=1).argmax())
        ids = np.flatnonzero(acts[t])
        step = seen_by(skill, _alone(trace, t, elapsed), elapsed[t, ids], ids, goal[t, ids])
        check_reads_goal(skill, step)
    over = acts & (end != RUNNING)
    terminated = acts & (trace["env_terminated"] | (end == OWN))
    reward = rewards_of(trace, skill, acts, elapsed, goal)
    truncated = over & ~terminated
    return Batch(reward=reward, terminated=terminated, truncated=truncated, valid=acts)


def rewards_of(
    trace: Trace, skill: Skill | None, acts: Array, elapsed: Array, goal: Array | None = None
) -> Array:
    """Return a skill's rewards, (T, N) float32; 0 where it does not act; see ``steps_of``."""
    if skill is None:
        return trace["env_reward"] if acts.all() else np.where(acts, trace["env_reward"], 0)
    return _spread(acts, judged(trace, skill, "reward", acts, elapsed, goal), np.float32)


def successes_of(
    trace: Trace, skill: Skill, acts: Array, elapsed: Array, goal: Array | None = None
) -> Array:
    """Return where a skill has succeeded, (T, N) bool; see ``steps_of``."""
    return _spread(acts, judged(trace, skill, "success", acts, elapsed, goal), np.bool_)


def call_successes(trace: Trace, skills: Sequence[Skill], path: str, over: Array) -> Array:
    """Return which calls of a level have succeeded, (T, N) bool.

    By the skill's ``success`` in the call's last step; of a skill without one, if its own
    termination ended the call.

    Args:
        skills: of the level.
        path: of the level, before the names of its columns.
        over: (T, N) bool, the steps in which its calls ended.
    """
    running, elapsed = trace[path + "skill"], trace[path + "call_elapsed"]
    succeeded: Array = over & (trace[path + "call_end"] == OWN)
    for i, skill in enumerate(skills):
        last = over & (running == i) if skill.defines("success") else None
        if last is not None and last.any():
            goal = trace.get(f"{path}{skill.name}/goal")
            succeeded[last] = judged(trace, skill, "success", last, elapsed, goal)
    return succeeded


def timed_out(trace: Trace, skill: Skill, elapsed: Array) -> Array:
    """Return where a skill's ``max_steps`` has ended its call, (T, N) bool."""
    if skill.max_steps is None:
        return np.zeros(elapsed.shape, bool)
    found: Array = (elapsed >= skill.max_steps) & ~trace["env_terminated"]
    return found


def judged(
    trace: Trace,
    skill: Skill,
    what: Literal["reward", "success"],
    acts: Array,
    elapsed: Array,
    goal: Array | None = None,
) -> Array:
    """Return a property of a skill's ``Outcome`` in the K rows where it acts, (K,), by time.

    A reward that changes (``Skill.reward_changes``) gets each step by itself, once, by time.

    Raises:
        SkillError: the skill's method failed, or returned a wrong result; the message is that
            of the first step in which it does.
    """
    alone = what == "reward" and skill.reward_changes
    most = 1 if alone else max(1, AT_ONCE // max(1, trace["obs"][0].nbytes))
    if len(acts) <= most:
        return _judged(trace, skill, what, acts, elapsed, goal)
    found = []
    for first in range(0, len(acts), most):
        part = slice(first, first + most)
        goals = None if goal is None else goal[part]
        found.append(_judged(trace.rows(part), skill, what, acts[part], elapsed[part], goals))
    return np.concatenate(found)


def _judged(
    trace: Trace, skill: Skill, what: str, acts: Array, elapsed: Array, goal: Array | None
) -> Array:
    steps = np.flatnonzero(acts.any(axis=1))
    if len(steps) > 1:
        step = _together(trace, steps, acts, elapsed)
        ids = np.nonzero(acts)[1]
        seen = seen_by(skill, step, step.elapsed, goal=None if goal is None else goal[acts])
        try:
            found: Array = getattr(judge(skill, seen, ids), what)
        except SkillweaveError:
            pass  # it is raised below, by the step that it is of
        else:
            if not step.info.mixed:  # type: ignore[attr-defined]
                return found
    each: list[Array] = [np.zeros(0, np.float32 if what == "reward" else np.bool_)]
    for t in steps.tolist():
        ids = np.flatnonzero(acts[t])
        own = None if goal is None else goal[t, ids]
        step = seen_by(skill, _alone(trace, t, elapsed), elapsed[t, ids], ids, own)
        each.append(getattr(judge(skill, step, ids), what))
    return np.concatenate(each)


def rows_of(
    trace: Trace,
    steps: Batch,
    path: str,
    elapsed: Array,
    record: Sequence[str],
    goals: Goals | None = None,
    part: OwnPart | None = None,
) -> Batch:
    """Return the steps of a learner with all that it may learn from.

    Args:
        path: before the names of the learner's own columns: empty, or ``inner/up/``.
        elapsed: (T, N) int64, steps of its calls so far.
        record: names of raw columns.
        goals: of the learner's skill: it observes them, too.
        part: of observations and actions that the learner's skill has; None: it has all.

    Raises:
        EnvError: no environment gives a key of ``info`` that is wanted.
    """
    names = ("obs", "next_obs", "mask", "next_mask", "overridden", *record)
    own = ("action", "dist_params")
    found = {k: _info_column(trace, k) if k.startswith(INFO) else trace.get(k) for k in names}
    if "call_elapsed" in record:
        found["call_elapsed"] = elapsed
    if part is not None:
        found |= {k: part.part.see(found[k]) for k in ("obs", "next_obs")}
        found |= {k: part.part.mask(found[k]) for k in ("mask", "next_mask")}
    if goals is not None:
        goal = trace[path + "goal"]
        found |= {k: goals.join(found[k], goal) for k in ("obs", "next_obs")}
    found |= {k: trace.get(path + k) for k in own} | {"steps": np.ones(trace.lead, np.int64)}
    return steps.replace(**found)


def info_numbers_of(trace: Trace, key: str) -> Array:
    """Return a key of ``info`` in all steps, (T, N, …) numbers.

    Raises:
        EnvError: a step has no such key, or no number for each environment.
    """
    for info in trace.infos:
        if key not in info:
            raise EnvError(f"info[{key!r}] is to be recorded, but {missing_key(info)}")
    values = [np.asarray(info[key]) for info in trace.infos]
    for value, info in zip(values, trace.infos, strict=True):
        if value.dtype.kind not in "biuf" or value.shape[:1] != trace.lead[1:]:
            raise EnvError(
                f"info[{key!r}] is to be recorded, but it is {short(info[key])}; a number for each "
                "environment is needed"
            )
    return np.stack(values)


def _info_column(trace: Trace, name: str) -> Array:
    key = name.removeprefix(INFO)
    for info in trace.infos:
        if key not in info:
            raise EnvError(f"info[{key!r}] is to be recorded, but {missing_key(info)}")
    return np.stack([np.asarray(info[key]) for info in trace.infos])


def _spread(acts: Array, values: Array, dtype: Any) -> Array:
    """Return values (K,) of the rows where ``acts`` (T, N) as (T, N); 0 elsewhere."""
    if values.size == acts.size:
        return values.reshape(acts.shape)
    found = np.zeros(acts.shape, dtype)
    found[acts] = values
    return found


def _alone(trace: Trace, t: int, elapsed: Array) -> Step:
    """Return step ``t`` of all environments."""
    return _step(trace, t, elapsed, trace.infos[t] if trace.infos else {})


def _together(trace: Trace, steps: Array, acts: Array, elapsed: Array) -> Step:
    """Return all rows where ``acts`` (T, N) as one step of K environments.

    Args:
        steps: those with such rows.
    """
    every = acts.all()
    flat = {
        name: x.reshape(-1, *x.shape[2:]) if every else x[acts]
        for name, x in (*((name, trace[name]) for name in OF_STEP), ("elapsed", elapsed))
    }
    infos = [trace.infos[t] for t in steps] if trace.infos else []
    return _made(flat, flat["elapsed"], JointInfo(infos, acts[steps]))


def _step(trace: Trace, t: int, elapsed: Array, info: Mapping[str, Any]) -> Step:
    return _made({name: trace[name][t] for name in OF_STEP}, elapsed[t], info)


def _made(columns: Mapping[str, Array], elapsed: Array, info: Mapping[str, Any]) -> Step:
    fields: dict[str, Any] = {field: columns[name] for name, field in OF_STEP.items()}
    never = np.zeros(len(elapsed), bool)
    return Step(**fields, timed_out=never, elapsed=elapsed, info=info)


class JointInfo(Mapping[str, Any]):
    """The infos of several steps as one of K rows; a key is joined when it is read.

    Args:
        infos: of S steps.
        acts: (S, N) bool, the K rows.
        whole: the info that this one is part of.
    """

    def __init__(
        self, infos: Sequence[Mapping[str, Any]], acts: Array, whole: JointInfo | None = None
    ) -> None:
        self._infos, self._acts, self._whole = infos, acts, whole
        self.mixed = False
        """A key was read that cannot be joined: it differs in its kind between steps."""

    def __getitem__(self, key: str) -> Any:
        values = [info[key] for info in self._infos if key in info]
        if not values:
            raise KeyError(key)
        first, envs = values[0], self._acts.shape[1]
        if len(values) < len(self._infos):
            self._mix()
        elif all(isinstance(v, dict) for v in values):
            return JointInfo(values, self._acts, self._whole or self)
        elif all(
            isinstance(v, np.ndarray)
            and v.shape[:1] == (envs,)
            and v.dtype == first.dtype
            and v.shape == first.shape
            for v in values
        ):
            return np.stack(values)[self._acts]
        else:
            self._mix()
        return first

    def __iter__(self) -> Iterator[str]:
        keys = {key: None for info in self._infos for key in info}
        if any(len(info) != len(keys) for info in self._infos):
            self._mix()
        return iter(keys)

    def __len__(self) -> int:
        return len(set(iter(self)))

    def _mix(self) -> None:
        (self._whole or self).mixed = True
